"""Checkpoints: tensors in safetensors, the rest as JSON in its header. Nothing that is read is ever
executed."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from mrgs.errors import RunError
from mrgs.field import RadianceField, nearest_neighbours
from mrgs.method.camera_model.image_model import Capture, ImageModel
from mrgs.method.config import TrainConfig
from mrgs.method.density.densification import ScreenStatistics
from mrgs.method.losses.radiation import DepthUncertainty
from mrgs.method.optimizer import GaussianOptimizer
from mrgs.render import Model
from mrgs.scene import Gaussians, Scene, TemperatureRange
from mrgs.system.atomic import replacing
from mrgs.system.gpu import HOST
from mrgs.training.step import TrainingState
from mrgs.training.views import ViewSampler

FORMAT = 4
"""Raised whenever older files can no longer be read."""


class CheckpointFacts(NamedTuple):
    """What a checkpoint says about its run besides the tensors.

    Attributes:
        step: steps done.
        scene: absolute path of the scene's folder.
        capture: what the image model must know of the scene's photos.
        temperature: the scene's scale; None without known °C.
        train_seconds: time spent in training so far.
        peak_memory_bytes: largest memory of the process since the run came to ``device``; on a GPU
            that of its tensors there.
        skipped_steps: steps skipped so far because of values that were not finite.
        device: that of the last step: a GPU's name, or "cpu".
    """

    step: int
    scene: str
    capture: Capture
    temperature: TemperatureRange | None
    train_seconds: float
    peak_memory_bytes: int
    skipped_steps: int
    device: str = "cpu"


def save(path: Path, state: TrainingState, facts: CheckpointFacts) -> None:
    """Write everything that training needs to go on exactly, in one file that is either whole or
    not there.

    Raises:
        RunError: the file cannot be written.
    """
    tensors = {
        f"gaussians.{name}": tensor for name, tensor in state.gaussian_optimizer.state().items()
    }
    tensors |= {f"field.{name}": tensor for name, tensor in state.model.field.state_dict().items()}
    tensors |= {
        f"uncertainty.{name}": tensor for name, tensor in state.uncertainty.state_dict().items()
    }
    tensors |= {
        f"image_model.{name}": tensor for name, tensor in state.image_model.state_dict().items()
    }
    tensors |= {
        f"layer_optimizer.{name}": tensor
        for name, tensor in _layer_moments(state.layer_optimizer).items()
    }
    tensors["statistics.gradient_sum"] = state.statistics.gradient_sum
    tensors["statistics.views"] = state.statistics.views
    tensors["sampler.waiting"] = state.sampler.state()
    tensors["generator"] = state.generator.get_state()
    if state.model.neighbours is not None:
        tensors["neighbours"] = state.model.neighbours
    write(path, tensors, facts, int(state.skipped_in_a_row))


def write(
    path: Path, tensors: dict[str, Tensor], facts: CheckpointFacts, skipped_in_a_row: int
) -> None:
    """Write a checkpoint of any method.

    Raises:
        RunError: the file cannot be written.
    """
    temperature = facts.temperature
    header = {
        **facts._asdict(),
        "format": FORMAT,
        "capture": facts.capture._asdict(),
        "temperature": None if temperature is None else [temperature.min_c, temperature.max_c],
        "skipped_in_a_row": skipped_in_a_row,
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
            f"{scene.name} has other cameras than the run's scene: use {facts.scene} as it was"
        )
    if facts.temperature != scene.temperature:
        raise RunError(
            f"{scene.name} has another temperature range than the run was trained with: "
            f"bring back the one that stood in {facts.scene}, or train anew"
        )


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


def load_state(path: Path, config: TrainConfig, device: torch.device = HOST) -> TrainingState:
    """The whole state of a checkpoint, to train on.

    Args:
        path: the checkpoint, written on whatever device.
        config: the run's configuration.
        device: where to train on.

    Raises:
        RunError: not a whole checkpoint of this format, or not of this configuration.
    """
    tensors, header = _read(path)
    facts = _facts(path, header)
    try:
        model = _model(tensors, config, facts).to(device)
        uncertainty = DepthUncertainty()
        uncertainty.load_state_dict(_below(tensors, "uncertainty."))
        generator = torch.Generator()
        generator.set_state(tensors["generator"])
        state = make_state(model, uncertainty, config, facts.capture, generator)
        state.image_model.load_state_dict(_below(tensors, "image_model."))
        state.gaussian_optimizer.load_moments(_below(tensors, "gaussians."))
        _load_layer_moments(state.layer_optimizer, _below(tensors, "layer_optimizer."))
        state.statistics = ScreenStatistics(
            *(tensors[f"statistics.{name}"].to(device) for name in ("gradient_sum", "views"))
        )
        state.sampler.load(tensors["sampler.waiting"])
        state.skipped_in_a_row += int(header["skipped_in_a_row"])
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise _mismatch(path) from error
    state.step = facts.step
    return state


def make_state(
    model: Model,
    uncertainty: DepthUncertainty,
    config: TrainConfig,
    capture: Capture,
    generator: torch.Generator,
) -> TrainingState:
    """A state at step 0: fresh optimizers around a model, on its device."""
    device = model.gaussians.means.device
    uncertainty = uncertainty.to(device)
    image_model = ImageModel(config.image_model, capture).to(device)
    gaussian_optimizer = GaussianOptimizer(model.gaussians, config.optimizer, capture.extent)
    model.gaussians = gaussian_optimizer.gaussians
    groups = [{"params": list(uncertainty.parameters()), "lr": config.optimizer.uncertainty}]
    layers = list(model.field.parameters())
    if layers:
        groups.append({"params": layers, "lr": config.optimizer.heads})
    groups += image_model.parameter_groups()
    groups = [{**group, "initial_lr": group["lr"]} for group in groups]
    return TrainingState(
        step=0,
        model=model,
        uncertainty=uncertainty,
        image_model=image_model,
        gaussian_optimizer=gaussian_optimizer,
        layer_optimizer=torch.optim.Adam(groups, fused=True),
        statistics=ScreenStatistics.empty(len(model.gaussians), device),
        sampler=ViewSampler(capture.views, generator),
        generator=generator,
        skipped_in_a_row=torch.zeros((), dtype=torch.int64, device=device),
    )


def _read(path: Path, with_tensors: bool = True) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and header of a checkpoint file."""
    try:
        with safe_open(path, framework="pt") as file:
            header = dict(json.loads((file.metadata() or {})["mrgs"]))
            tensors = {name: file.get_tensor(name) for name in file.keys()} if with_tensors else {}  # noqa: SIM118
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise _damaged(path) from error
    if header.get("format") != FORMAT:
        raise RunError(
            f"{path} has checkpoint format {header.get('format')}, this program reads {FORMAT}: "
            f"train anew"
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
        return CheckpointFacts(**values)
    except (KeyError, TypeError, ValueError) as error:
        raise _damaged(path) from error


def _model(tensors: dict[str, Tensor], config: TrainConfig, facts: CheckpointFacts) -> Model:
    parameters = _below(tensors, "gaussians.")
    gaussians = Gaussians(
        **{name: tensor for name, tensor in parameters.items() if not name.startswith("adam.")}
    )
    neighbours = tensors.get("neighbours")
    _check_rows(gaussians, neighbours)
    if (
        gaussians.temperature_rest.shape[1]
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


def _layer_parameters(optimizer: torch.optim.Adam) -> list[nn.Parameter]:
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def _layer_moments(optimizer: torch.optim.Adam) -> dict[str, Tensor]:
    """Moments by the place of their parameter."""
    return {
        f"{place}.{key}": value
        for place, parameter in enumerate(_layer_parameters(optimizer))
        for key, value in optimizer.state.get(parameter, {}).items()
    }


def _load_layer_moments(optimizer: torch.optim.Adam, tensors: dict[str, Tensor]) -> None:
    for place, parameter in enumerate(_layer_parameters(optimizer)):
        state = _below(tensors, f"{place}.")
        if state:
            optimizer.state[parameter] = {
                key: value.to(parameter.device) for key, value in state.items()
            }


def _damaged(path: Path) -> RunError:
    return RunError(
        f"{path} is not a whole checkpoint: delete it, and the one before it is used; without "
        f"one, train anew"
    )


def _mismatch(path: Path) -> RunError:
    return RunError(
        f"{path} does not fit the run's config.yaml: restore the configuration it was trained with"
    )
