"""Checkpoints of a training of Gaussians: everything needed to resume exactly, and to render."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mrgs.errors import DamagedCheckpointError, RunError
from mrgs.field import RadianceField
from mrgs.method.camera_model.image_model import ImageModel
from mrgs.method.config import TrainConfig
from mrgs.method.density import Strategy
from mrgs.method.losses.term import Term
from mrgs.method.losses.terms import configured_terms
from mrgs.render import Model
from mrgs.system.gpu import HOST
from mrgs.system.torch_modes import seeded
from mrgs.training.checkpoint_file import read_file, read_header, write_file
from mrgs.training.checkpoint_layout import (
    below,
    gaussians_from,
    require_like,
    require_neighbours,
)
from mrgs.training.facts import CheckpointFacts
from mrgs.training.run_folder import step_named
from mrgs.training.state import TrainingState, learned_layers

UNFIT = (KeyError, RuntimeError, TypeError, ValueError)
"""What is raised for tensors that are not those of the configuration."""

_SETTINGS = "strategy_settings"

_MOST_SHOWN = 60
"""Characters of a setting in a message."""


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
    """Write everything needed to resume exactly, in one file that is either whole or not there.

    Raises:
        NotFiniteError: the state holds a NaN or an infinity; nothing is written.
        RunError: the file cannot be written.
    """
    write_file(path, tensors_of(state), header_of(state, facts))


def header_of(state: TrainingState, facts: CheckpointFacts) -> dict[str, Any]:
    """The header of a state's checkpoint, for JSON."""
    made_with = _made_with(state.strategy, state.terms)
    settings = {_SETTINGS: _stated_settings(state.strategy)}
    skipped = {"skipped_in_a_row": int(state.skipped_in_a_row)}
    return {**facts.to_json(), **skipped, **made_with, **settings}


def write(
    path: Path,
    tensors: Mapping[str, Tensor],
    facts: CheckpointFacts,
    skipped_in_a_row: int,
) -> None:
    """Write a checkpoint of any method.

    Args:
        path: the file.
        tensors: by name.
        facts: about the run.
        skipped_in_a_row: steps skipped since the last good one.

    Raises:
        NotFiniteError: a tensor holds a NaN or an infinity; nothing is written.
        RunError: the file cannot be written.
    """
    write_file(path, tensors, {**facts.to_json(), "skipped_in_a_row": skipped_in_a_row})


def read(
    path: Path, needed: Callable[[str], bool] = lambda name: True
) -> tuple[dict[str, Tensor], CheckpointFacts, dict[str, Any]]:
    """Tensors, facts and header of a checkpoint of any method.

    Args:
        path: the checkpoint.
        needed: whether the tensor of a name is to be returned; all are checked.

    Raises:
        DamagedCheckpointError: it is not what was written, or not finite.
        RunError: it cannot be read, or is of another format.
    """
    tensors, header = read_file(path, needed)
    return tensors, _facts(path, header), header


def load_facts(path: Path) -> CheckpointFacts:
    """The facts of a checkpoint, without its tensors.

    Raises:
        DamagedCheckpointError: not a checkpoint, or another header than was written.
        RunError: it cannot be read, or is of another format.
    """
    return _facts(path, read_header(path))


def load_model(path: Path, config: TrainConfig) -> tuple[Model, CheckpointFacts, ImageModel]:
    """The model of a checkpoint, to render with, and what its scene's cameras do to the images.

    Raises:
        DamagedCheckpointError: it is not what was written, or not finite.
        RunError: it cannot be read, is of another format, or not of this configuration.
    """
    tensors, facts, _ = read(path, _renders)
    try:
        model = _model(tensors, config, facts)
        image_model = ImageModel(config.image_model, facts.capture)
        _load_module(image_model, below(tensors, "image_model."))
    except UNFIT as error:
        raise unfit(path, error) from error
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
    """The whole state of a checkpoint, to train on.

    Args:
        path: the checkpoint, written on any device.
        config: the run's configuration.
        device: where to train on.
        strategy: density control, if the run was given one.
        terms: of the loss, if the run was given any.

    Raises:
        DamagedCheckpointError: it is not what was written, or not finite.
        RunError: it cannot be read, is of another format, not of this configuration, or of another
            strategy or other terms.
    """
    return state_of(*read(path), path, config, device, strategy, terms)


def state_of(
    tensors: Mapping[str, Tensor],
    facts: CheckpointFacts,
    header: Mapping[str, Any],
    path: Path,
    config: TrainConfig,
    device: torch.device = HOST,
    strategy: Strategy | None = None,
    terms: Sequence[Term] = (),
) -> TrainingState:
    """The state that ``tensors_of`` and ``header_of`` describe; see ``load_state``.

    Args:
        tensors: by name.
        facts: in the header.
        header: of the checkpoint.
        path: where it comes from, for messages.
        config: the run's configuration.
        device: where to train on.
        strategy: density control, if the run was given one.
        terms: of the loss, if the run was given any.

    Raises:
        RunError: it is not of this configuration, or of another strategy, a strategy with other
            settings, or other terms.
    """
    chosen = config.densification if strategy is None else strategy
    try:
        model = _model(tensors, config, facts).to(device)
    except UNFIT as error:
        raise unfit(path, error) from error
    with seeded(config.seed):
        all_terms = configured_terms(config, terms, model.gaussians.modalities)
    _require_made_with(path, header, _made_with(chosen, all_terms))
    if strategy is not None:
        _require_settings(path, header, strategy)
    try:
        for term, module in learned_layers(all_terms).items():
            _load_module(module, below(tensors, f"terms.{term}."))
        generator = torch.Generator()
        generator.set_state(tensors["generator"])
        state = TrainingState.around(model, all_terms, chosen, config, facts.capture, generator)
        _load_training(state, tensors)
        state.skipped_in_a_row += skipped_in_a_row_of(header)
        state.step = facts.step
        require_like(tensors, tensors_of(state))
    except UNFIT as error:
        raise unfit(path, error) from error
    return state


def skipped_in_a_row_of(header: Mapping[str, Any]) -> int:
    """Steps skipped since the last good one.

    Raises:
        KeyError, ValueError: the header does not say it.
    """
    count = header["skipped_in_a_row"]
    if type(count) is not int or count < 0:
        raise ValueError("skipped_in_a_row is a number of at least 0")
    return count


def unfit(path: Path, error: Exception) -> RunError:
    """The error for a checkpoint whose tensors are not those that its configuration implies."""
    reason = " ".join(str(error).split())
    return RunError(
        f"{path} does not fit the run's config.yaml ({reason:.120}): restore the configuration it "
        f"was trained with"
    )


def _renders(name: str) -> bool:
    """Whether a model is rendered with the tensor of a name: all but those that training needs."""
    return name.startswith(("gaussians.", "field.", "image_model.", "neighbours")) and not (
        name.startswith("gaussians.adam.")
    )


def _load_training(state: TrainingState, tensors: Mapping[str, Tensor]) -> None:
    """Fill a state at step 0 with all that its model does not hold.

    Raises:
        KeyError, RuntimeError, TypeError, ValueError: the tensors are not those of such a state.
    """
    _load_module(state.image_model, below(tensors, "image_model."))
    state.gaussian_optimizer.load_moments(below(tensors, "gaussians."))
    layers = dict(enumerate(state.layer_optimizer.parameters()))
    state.layer_optimizer.load_moments(layers, below(tensors, "layer_optimizer."))
    remembered = below(tensors, "strategy.")
    require_like(remembered, state.strategy_state)
    state.strategy_state = {name: each.to(state.device) for name, each in remembered.items()}
    state.sampler.load(tensors["sampler.waiting"])


def _load_module(module: torch.nn.Module, tensors: Mapping[str, Tensor]) -> None:
    require_like(tensors, module.state_dict())
    module.load_state_dict(tensors)


def _made_with(strategy: Strategy, terms: Sequence[Term]) -> dict[str, Any]:
    """What a configuration need not say, because Python may have given it."""
    return {"strategy": type(strategy).__name__, "terms": [term.name for term in terms]}


def _require_made_with(path: Path, header: Mapping[str, Any], made_with: dict[str, Any]) -> None:
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


def _require_settings(path: Path, header: Mapping[str, Any], strategy: Strategy) -> None:
    """A strategy that Python gives has the settings that it had; those of a configuration are in
    the run's config.yaml.

    Raises:
        RunError: they are others.
    """
    settings = header.get(_SETTINGS, {})
    for name, now in _stated_settings(strategy).items():
        before = settings.get(name, now)
        if now not in (before, repr(before)):  # earlier versions wrote numbers and texts as such
            raise RunError(
                f"{path} was trained with {name}={_shortened(str(before))} in "
                f"{type(strategy).__name__}, not {_shortened(now)}: give train() the same "
                f"strategy and terms again"
            )


def _stated_settings(strategy: Strategy) -> dict[str, str]:
    """What a header says of a strategy's settings: each as Python writes it, but for those whose
    text is another in each process."""
    stated = {name: _stated(value) for name, value in strategy.settings().items()}
    return {name: text for name, text in stated.items() if " at 0x" not in text}


def _stated(value: object) -> str:
    """A value as Python writes it; numbers of NumPy as the same ones of Python, sets in order."""
    if isinstance(value, np.generic):
        return repr(value.item())
    if isinstance(value, set | frozenset):
        return f"{type(value).__name__}({sorted(map(_stated, value))})"
    return repr(value)


def _shortened(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= _MOST_SHOWN else f"{line[: _MOST_SHOWN - 3]}..."


def _facts(path: Path, header: Mapping[str, Any]) -> CheckpointFacts:
    """The facts in a header; one that was copied under the name of another step would hide newer
    ones."""
    try:
        facts = CheckpointFacts.from_json(header)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DamagedCheckpointError(path, "its header lacks facts") from error
    if step_named(path) not in (None, facts.step):
        raise DamagedCheckpointError(path, f"it is the one of step {facts.step}")
    return facts


def _model(tensors: Mapping[str, Tensor], config: TrainConfig, facts: CheckpointFacts) -> Model:
    """The model of a checkpoint.

    Raises:
        ValueError: the tensors are not those of a model of this configuration.
    """
    named = below(tensors, "gaussians.")
    parameters = {name: each for name, each in named.items() if not name.startswith("adam.")}
    gaussians = gaussians_from(parameters, config, facts)
    neighbours = tensors.get("neighbours")
    require_neighbours(neighbours, len(gaussians), config.field.neighbours_k)
    with seeded(config.seed):
        field = RadianceField(config.field)
    _load_module(field, below(tensors, "field."))
    return Model(
        gaussians=gaussians,
        field=field,
        neighbours=neighbours,
        sh_degree=config.sh_degree_at(facts.step),
        dilation=config.dilation_of(facts.capture),
    )
