"""Checkpoints of a training of Gaussians: everything needed to resume exactly, and to render."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mrgs.errors import RunError
from mrgs.field import RadianceField
from mrgs.field.spherical_harmonics import C0, MAX_DEGREE
from mrgs.method.camera_model.image_model import ImageModel
from mrgs.method.config import TrainConfig
from mrgs.method.density import Strategy
from mrgs.method.losses.term import Term
from mrgs.method.losses.terms import configured_terms
from mrgs.method.start.start_points import blended_apart
from mrgs.render import Model
from mrgs.run_files.checkpoint import (
    below,
    fitting,
    read,
    require_like,
    skipped_in_a_row_of,
    write_file,
)
from mrgs.run_files.facts import CheckpointFacts
from mrgs.run_files.folder import RunFolder
from mrgs.scene import THERMAL, Gaussians
from mrgs.scene.capture import model_modalities
from mrgs.system.gpu import HOST
from mrgs.system.torch_modes import seeded
from mrgs.training.state import TrainingState, learned_layers

_SETTINGS = "strategy_settings"


def tensors_of(state: TrainingState) -> dict[str, Tensor]:
    """All tensors of a training, by name."""
    layers = dict(enumerate(state.layer_optimizer.parameters()))
    parts: dict[str, Mapping[str, Tensor]] = {
        "gaussians": state.gaussian_optimizer.state(),
        "field": state.model.field.state_dict(),
        "image_model": state.image_model.state_dict(),
        "layer_optimizer": state.layer_optimizer.moments(layers),
        "strategy": state.strategy_state,
    }
    for term, module in learned_layers(state.terms).items():
        parts[f"terms.{term}"] = module.state_dict()
    tensors = {
        f"{part}.{name}": tensor for part, named in parts.items() for name, tensor in named.items()
    }
    tensors["sampler.waiting"] = state.sampler.state()
    tensors["generator"] = state.generator.get_state()
    if state.model.neighbours is not None:
        tensors["neighbours"] = state.model.neighbours
    return tensors


def save(path: Path, state: TrainingState, facts: CheckpointFacts) -> None:
    """Write everything needed to resume exactly; see ``write_file``."""
    header = {
        **facts.to_json(),
        "skipped_in_a_row": int(state.skipped_in_a_row),
        **_made_with(state.strategy, state.terms),
    }
    write_file(path, tensors_of(state), header)


def load_model(path: Path, config: TrainConfig) -> tuple[Model, CheckpointFacts, ImageModel]:
    """The model of a checkpoint, to render with, and what its scene's cameras do to the images.
    DamagedCheckpointError if it is not what was written, or not finite; RunError if it cannot be
    read, has another format, or does not fit the configuration."""
    needed = ("gaussians.", "field.", "image_model.", "neighbours")
    tensors, facts, _ = read(
        path, lambda name: name.startswith(needed) and not name.startswith("gaussians.adam.")
    )
    with fitting(path):
        model = _model(tensors, config, facts)
        image_model = ImageModel(config.image_model, facts.capture)
        _load_module(image_model, below(tensors, "image_model."))
    if model.neighbours is None:  # saved right after a densification
        model.neighbours = model.field.neighbours_of(model.gaussians.means)
    return model, facts, image_model


def load_state(
    path: Path,
    config: TrainConfig,
    device: torch.device = HOST,
    strategy: Strategy | None = None,
    terms: Sequence[Term] = (),
) -> TrainingState:
    """The whole state of a checkpoint that was written on any device, to train on with the strategy
    and the terms that the run was given. DamagedCheckpointError if it is not what was written, or
    not finite; RunError if it cannot be read, has another format, does not fit the configuration,
    or was written with another strategy, a strategy with other settings, or other terms."""
    tensors, facts, header = read(path)
    chosen = config.densification if strategy is None else strategy
    with fitting(path):
        model = _model(tensors, config, facts).to(device)
    with seeded(config.seed):
        all_terms = configured_terms(config, terms, model.gaussians.modalities)
    _require_made_with(path, header, _made_with(chosen, all_terms), strategy is not None)
    with fitting(path):
        for term, module in learned_layers(all_terms).items():
            _load_module(module, below(tensors, f"terms.{term}."))
        generator = torch.Generator()
        generator.set_state(tensors["generator"])
        state = TrainingState.around(model, all_terms, chosen, config, facts.capture, generator)
        _load_module(state.image_model, below(tensors, "image_model."))
        state.gaussian_optimizer.load_moments(below(tensors, "gaussians."))
        layers = dict(enumerate(state.layer_optimizer.parameters()))
        state.layer_optimizer.load_moments(layers, below(tensors, "layer_optimizer."))
        remembered = below(tensors, "strategy.")
        require_like(remembered, state.strategy_state)
        state.strategy_state = {name: each.to(device) for name, each in remembered.items()}
        state.sampler.load(tensors["sampler.waiting"])
        state.skipped_in_a_row += skipped_in_a_row_of(header)
        state.step = facts.step
        require_like(tensors, tensors_of(state))
    return state


def shift_temperatures(folder: RunFolder, celsius: float) -> None:
    """Add a constant to all temperatures of a run's newest checkpoint; what its cameras are
    expected to record stays the same. RunError if the run is being trained, or the checkpoint
    cannot be read or written."""
    with folder.locked():
        path, (tensors, facts, header) = folder.load_newest(lambda path: (path, read(path)))
        assert facts.temperature is not None
        constant = celsius / facts.temperature.span_c
        tensors[f"gaussians.sh_dc.{THERMAL}"] += constant / C0
        tensors["image_model.constant"] += constant
        write_file(path, tensors, header)


def _load_module(module: torch.nn.Module, tensors: Mapping[str, Tensor]) -> None:
    require_like(tensors, module.state_dict())
    module.load_state_dict(tensors)


def _made_with(strategy: Strategy, terms: Sequence[Term]) -> dict[str, Any]:
    """The parts that may come from Python instead of the configuration; a strategy's settings
    without those whose ``repr`` contains an address and so differs between processes."""
    settings = {name: repr(value) for name, value in strategy.settings().items()}
    return {
        "strategy": type(strategy).__name__,
        "terms": [term.name for term in terms],
        _SETTINGS: {name: text for name, text in settings.items() if " at 0x" not in text},
    }


def _require_made_with(
    path: Path, header: Mapping[str, Any], now: Mapping[str, Any], from_python: bool
) -> None:
    """Check that a run resumes with the strategy and the terms that it started with; the settings
    of a strategy that is not from Python are in the run's config.yaml. RunError if they differ."""
    found = {name: (header.get(name), now[name]) for name in ("strategy", "terms")}
    if from_python:
        settings = header.get(_SETTINGS, {})
        for name, value in now[_SETTINGS].items():
            found[f"{now['strategy']}'s {name}"] = settings.get(name, value), value
    for name, (before, value) in found.items():
        if before != value:
            raise RunError(
                f"{path} was trained with {name} {before!s:.60}, not {value!s:.60}: give train() "
                f"the same strategy and terms again"
            )


def _model(tensors: Mapping[str, Tensor], config: TrainConfig, facts: CheckpointFacts) -> Model:
    """The model of a checkpoint. ValueError if the tensors do not fit the configuration."""
    gaussians = gaussians_from(parameters_of_gaussians(tensors), config, facts)
    neighbours, k = tensors.get("neighbours"), config.field.neighbours_k
    if neighbours is not None:  # they may be missing right after a densification
        if k == 0:
            raise ValueError("neighbours is unknown")
        like = torch.empty(len(gaussians), k, dtype=torch.int64, device="meta")
        require_like({"neighbours": neighbours}, {"neighbours": like})
        if not 0 <= int(neighbours.min()) <= int(neighbours.max()) < len(gaussians):
            raise ValueError("neighbours names Gaussians that do not exist")
    with seeded(config.seed):
        field = RadianceField(config.field)
    _load_module(field, below(tensors, "field."))
    return Model(
        gaussians=gaussians,
        field=field,
        neighbours=neighbours,
        sh_degree=config.sh_degree_at(facts.step),
        dilation=config.dilation_of(facts.capture),
        radiance=config.radiance_of(facts.capture),
    )


def parameters_of_gaussians(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The parameters of the Gaussians in a checkpoint, without moments."""
    named = below(tensors, "gaussians.")
    return {name: each for name, each in named.items() if not name.startswith("adam.")}


def gaussians_from(
    tensors: Mapping[str, Tensor], config: TrainConfig, facts: CheckpointFacts
) -> Gaussians:
    """The Gaussians of a checkpoint, from the parameters by name, as in ``Gaussians.tensors``.
    ValueError if they do not fit a model of this configuration."""
    modalities = model_modalities(facts.modalities)
    means = tensors.get("means")
    if means is None or means.dim() != 2 or len(means) == 0:
        raise ValueError("there are no Gaussians")
    count = len(means)
    shapes: dict[str, tuple[int, ...]] = {
        "means": (count, 3),
        "quats": (count, 4),
        "log_scales": (count, 3),
        "embedding": (count, config.field.embedding_width if config.field.residuals else 0),
    }
    for modality in blended_apart(facts.modalities, config.shares_opacity):
        shapes[f"opacity_logit.{modality}"] = (count, 1)
    for modality in modalities:
        degree = MAX_DEGREE
        if modality == THERMAL:
            degree = config.temperature_sh_degree_of(facts.capture)
        shapes[f"sh_dc.{modality}"] = (count, 1, modality.channels)
        shapes[f"sh_rest.{modality}"] = (count, (degree + 1) ** 2 - 1, modality.channels)
    require_like(
        tensors, {name: torch.empty(shape, device="meta") for name, shape in shapes.items()}
    )
    return Gaussians.from_tensors(tensors, modalities)
