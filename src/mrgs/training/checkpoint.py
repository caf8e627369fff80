"""Checkpoints: tensors in safetensors, the rest as JSON in its header. Nothing that is read is ever
executed."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from mrgs.errors import RunError
from mrgs.field import RadianceField, nearest_neighbours
from mrgs.method.camera_model.image_model import Capture, ImageModel
from mrgs.method.config import TrainConfig
from mrgs.method.density import Strategy
from mrgs.method.losses.term import Term
from mrgs.method.losses.terms import configured_terms
from mrgs.method.start.start_points import model_modalities
from mrgs.render import Model
from mrgs.scene import RGB, THERMAL, Gaussians, Modality, Scene, TemperatureRange
from mrgs.system.atomic import replacing
from mrgs.system.gpu import HOST
from mrgs.training.state import TrainingState, layer_parameters, learned_layers

FORMAT = 5
"""Raised whenever older files can no longer be read."""


class CheckpointFacts(NamedTuple):
    """The facts about a run that its checkpoints hold besides the tensors.

    Attributes:
        step: steps done.
        scene: absolute path of the scene's folder; empty for a scene made from arrays.
        capture: what the image model must know of the scene's photos.
        temperature: the scene's scale; None without known °C.
        train_seconds: time spent in training so far.
        peak_memory_bytes: largest memory of the process since the run came to ``device``; on a GPU
            that of its tensors there.
        skipped_steps: steps skipped so far because of values that were not finite.
        device: that of the last step: a GPU's name, or "cpu".
        modalities: of the scene's images.
    """

    step: int
    scene: str
    capture: Capture
    temperature: TemperatureRange | None
    train_seconds: float
    peak_memory_bytes: int
    skipped_steps: int
    device: str = "cpu"
    modalities: tuple[Modality, ...] = (RGB, THERMAL)

    @classmethod
    def at_start(cls, scene: Scene) -> CheckpointFacts:
        """Before the first step on a scene."""
        capture, modalities = Capture.of(scene), scene.modalities
        return cls(0, scene.path, capture, scene.temperature, 0.0, 0, 0, modalities=modalities)

    def moved_to(self, path: str | Path | None) -> CheckpointFacts:
        """These facts with the scene's current path, if one is given."""
        return self if path is None else self._replace(scene=str(Path(path).resolve()))


def save(path: Path, state: TrainingState, facts: CheckpointFacts) -> None:
    """Write everything needed to resume exactly, in one file that is either whole or
    not there.

    Raises:
        RunError: the file cannot be written.
    """
    parts: dict[str, Mapping[str, Tensor]] = {
        "gaussians": state.gaussian_optimizer.state(),
        "field": state.model.field.state_dict(),
        "image_model": state.image_model.state_dict(),
        "layer_optimizer": _layer_moments(state.layer_optimizer),
        "strategy": state.strategy_state,
    }
    for term, layers in learned_layers(state.terms).items():
        parts[f"terms.{term}"] = layers.state_dict()
    tensors = {
        f"{part}.{name}": tensor for part, named in parts.items() for name, tensor in named.items()
    }
    tensors["sampler.waiting"] = state.sampler.state()
    tensors["generator"] = state.generator.get_state()
    if state.model.neighbours is not None:
        tensors["neighbours"] = state.model.neighbours
    made_with = _made_with(state.strategy, state.terms)
    write(path, tensors, facts, int(state.skipped_in_a_row), made_with)


def write(
    path: Path,
    tensors: dict[str, Tensor],
    facts: CheckpointFacts,
    skipped_in_a_row: int,
    more: Mapping[str, Any] | None = None,
) -> None:
    """Write a checkpoint of any method.

    Args:
        path: the file.
        tensors: by name.
        facts: about the run.
        skipped_in_a_row: steps skipped since the last good one.
        more: entries of the header that only the method reads, for JSON.

    Raises:
        RunError: the file cannot be written.
    """
    temperature = facts.temperature
    header = {
        **facts._asdict(),
        "format": FORMAT,
        "capture": facts.capture._asdict(),
        "modalities": [modality.to_json() for modality in facts.modalities],
        "temperature": None if temperature is None else [temperature.min_c, temperature.max_c],
        "skipped_in_a_row": skipped_in_a_row,
        **(more or {}),
    }
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with replacing(path) as temporary:
        safetensors.torch.save_file(contiguous, temporary, {"mrgs": json.dumps(header)})


def load_facts(path: Path) -> CheckpointFacts:
    """The facts of a checkpoint, without its tensors.

    Raises:
        RunError: not a whole checkpoint of this format.
    """
    return _facts(path, _read(path, with_tensors=False)[1])


def require_same_scene(facts: CheckpointFacts, scene: Scene) -> None:
    """A run belongs to the cameras and the temperatures that it was trained with.

    Raises:
        RunError: the scene has others.
    """
    same_views = facts.capture.views == len(scene.train)
    if not same_views or not math.isclose(facts.capture.extent, scene.extent, rel_tol=1e-6):
        raise RunError(
            f"{scene.name} has other cameras than the run's scene: use that scene as it was"
        )
    if facts.temperature != scene.temperature:
        raise RunError(
            f"{scene.name} has another temperature range than the run was trained with: "
            f"bring back the one that it had, or retrain"
        )


def facts_to_resume(path: Path, scene: Scene) -> CheckpointFacts:
    """The facts of a checkpoint that is trained on, with the current path of its scene.

    Raises:
        RunError: not a whole checkpoint of this format, of another scene, or of fewer modalities.
    """
    facts = load_facts(path)
    require_same_scene(facts, scene)
    if untrained := set(scene.modalities) - set(model_modalities(facts.modalities)):
        names = ", ".join(sorted(each.name for each in untrained))
        raise RunError(f"{scene.name} has images that the run began without ({names}): retrain")
    return facts._replace(scene=scene.path, capture=Capture.of(scene))


def load_model(path: Path, config: TrainConfig) -> tuple[Model, CheckpointFacts, ImageModel]:
    """The model of a checkpoint, to render with, and what its scene's cameras do to the images.

    Raises:
        RunError: not a whole checkpoint of this format, or not of this configuration.
    """
    tensors, header = _read(path)
    facts = _facts(path, header)
    try:
        model = _model(tensors, config, facts)
        image_model = ImageModel(config.image_model, facts.capture)
        image_model.load_state_dict(_below(tensors, "image_model."))
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise _mismatch(path) from error
    if (
        model.neighbours is None and config.field.neighbours_k > 0
    ):  # saved right after a densification
        model.neighbours = nearest_neighbours(model.gaussians.means, config.field.neighbours_k)
    return model, facts, image_model


def load_state(
    path: Path,
    config: TrainConfig,
    device: torch.device = HOST,
    strategy: Strategy | None = None,
    terms: Sequence[Term] = (),
) -> TrainingState:
    """The whole state of a checkpoint, to train on.

    Args:
        path: the checkpoint, written on any device.
        config: the run's configuration.
        device: where to train on.
        strategy: density control, if the run was given one.
        terms: of the loss, if the run was given any.

    Raises:
        RunError: not a whole checkpoint of this format, not of this configuration, or of another
            strategy or other terms.
    """
    tensors, header = _read(path)
    facts = _facts(path, header)
    strategy = config.densification if strategy is None else strategy
    try:
        model = _model(tensors, config, facts).to(device)
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise _mismatch(path) from error
    all_terms = configured_terms(config, terms, model.gaussians.modalities)
    _require_made_with(path, header, _made_with(strategy, all_terms))
    try:
        generator = torch.Generator()
        generator.set_state(tensors["generator"])
        for term, layers in learned_layers(all_terms).items():
            layers.load_state_dict(_below(tensors, f"terms.{term}."))
        state = TrainingState.around(model, all_terms, strategy, config, facts.capture, generator)
        state.image_model.load_state_dict(_below(tensors, "image_model."))
        state.gaussian_optimizer.load_moments(_below(tensors, "gaussians."))
        _load_layer_moments(state.layer_optimizer, _below(tensors, "layer_optimizer."))
        state.strategy_state = {
            name: tensor.to(device) for name, tensor in _below(tensors, "strategy.").items()
        }
        state.sampler.load(tensors["sampler.waiting"])
        state.skipped_in_a_row += int(header["skipped_in_a_row"])
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise _mismatch(path) from error
    state.step = facts.step
    return state


def _made_with(strategy: Strategy, terms: Sequence[Term]) -> dict[str, Any]:
    """What a configuration need not say, because Python may have given it."""
    return {"strategy": type(strategy).__name__, "terms": [term.name for term in terms]}


def _require_made_with(path: Path, header: dict[str, Any], made_with: dict[str, Any]) -> None:
    """A run resumes with the strategy and the terms that it started with.

    Raises:
        RunError: they are others.
    """
    for name, value in made_with.items():
        if header.get(name) != value:
            raise RunError(
                f"{path} was trained with {name} {header.get(name)}, not {value}: give train() "
                f"the same strategy and terms again"
            )


def _read(path: Path, with_tensors: bool = True) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and header of a checkpoint file."""
    try:
        with safe_open(path, framework="pt") as file:
            header = dict(json.loads((file.metadata() or {})["mrgs"]))
            names = file.keys() if with_tensors else ()
            tensors = {name: file.get_tensor(name) for name in names}
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise _damaged(path) from error
    if header.get("format") != FORMAT:
        raise RunError(
            f"{path} has checkpoint format {header.get('format')}, this program reads {FORMAT}: "
            f"retrain"
        )
    return tensors, header


def _facts(path: Path, header: dict[str, Any]) -> CheckpointFacts:
    try:
        known = {"device": "cpu", **header}  # older checkpoints do not say it
        values = {name: known[name] for name in CheckpointFacts._fields}
        bounds = values["temperature"]
        if not isinstance(values["scene"], str) or not isinstance(values["device"], str):
            raise TypeError("the scene is a path, the device a name")
        values["temperature"] = None if bounds is None else TemperatureRange(*bounds)
        values["capture"] = Capture.from_json(values["capture"])
        values["modalities"] = tuple(map(Modality.from_json, values["modalities"]))
        return CheckpointFacts(**values)
    except (KeyError, TypeError, ValueError) as error:
        raise _damaged(path) from error


def _model(tensors: dict[str, Tensor], config: TrainConfig, facts: CheckpointFacts) -> Model:
    parameters = _below(tensors, "gaussians.")
    gaussians = Gaussians.from_tensors(
        {name: tensor for name, tensor in parameters.items() if not name.startswith("adam.")},
        model_modalities(facts.modalities),
    )
    _check_modalities(gaussians, facts)
    neighbours = tensors.get("neighbours")
    _check_rows(gaussians, neighbours)
    if (
        gaussians.sh_rest[THERMAL].shape[1]
        != (config.temperature_sh_degree_of(facts.capture) + 1) ** 2 - 1
    ):
        raise ValueError("the temperatures are of another degree")
    field = RadianceField(config.field)
    field.load_state_dict(_below(tensors, "field."))
    return Model(
        gaussians=gaussians,
        field=field,
        neighbours=neighbours,
        sh_degree=config.sh_degree_at(facts.step),
    )


def _check_modalities(gaussians: Gaussians, facts: CheckpointFacts) -> None:
    """The Gaussians must have the appearance of all modalities, and the opacity of all or of the
    first.

    Raises:
        ValueError: one is missing, or has another number of channels.
    """
    modalities = model_modalities(facts.modalities)
    has = [tuple(group) for group in (gaussians.sh_dc, gaussians.sh_rest)]
    opacities = tuple(gaussians.opacity_logits)
    if has != [modalities, modalities] or opacities not in (modalities, modalities[:1]):
        raise ValueError("a modality is missing")
    for modality in modalities:
        dc, rest = gaussians.sh_dc[modality], gaussians.sh_rest[modality]
        if dc.shape[1:] != (1, modality.channels) or rest.shape[2:] != (modality.channels,):
            raise ValueError(f"{modality} has another number of channels")


def _check_rows(gaussians: Gaussians, neighbours: Tensor | None) -> None:
    """What is rendered must be whole: kernels trust it.

    Raises:
        ValueError: tensors of different lengths or of other types, or neighbours that do not exist.
    """
    count = len(gaussians)
    if any(
        len(tensor) != count or tensor.dtype != torch.float32
        for tensor in gaussians.tensors().values()
    ):
        raise ValueError("the Gaussians' tensors do not belong together")
    if neighbours is not None and neighbours.numel() > 0:
        lowest, highest = int(neighbours.min()), int(neighbours.max())
        if len(neighbours) != count or lowest < 0 or highest >= count:
            raise ValueError("the neighbours are not those of the Gaussians")


def _below(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {
        name.removeprefix(prefix): tensor
        for name, tensor in tensors.items()
        if name.startswith(prefix)
    }


def _layer_moments(optimizer: torch.optim.Adam) -> dict[str, Tensor]:
    """Moments by the index of their parameter."""
    return {
        f"{place}.{key}": value
        for place, parameter in enumerate(layer_parameters(optimizer))
        for key, value in optimizer.state.get(parameter, {}).items()
    }


def _load_layer_moments(optimizer: torch.optim.Adam, tensors: dict[str, Tensor]) -> None:
    for place, parameter in enumerate(layer_parameters(optimizer)):
        state = _below(tensors, f"{place}.")
        if state:
            optimizer.state[parameter] = {
                key: value.to(parameter.device) for key, value in state.items()
            }


def _damaged(path: Path) -> RunError:
    return RunError(
        f"{path} is not a whole checkpoint: delete it, and the one before it is used; without "
        f"one, retrain"
    )


def _mismatch(path: Path) -> RunError:
    return RunError(
        f"{path} does not fit the run's config.yaml: restore the configuration it was trained with"
    )
