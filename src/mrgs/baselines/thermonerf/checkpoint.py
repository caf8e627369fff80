"""Checkpoints in the form of ``mrgs.training.checkpoint``: safetensors with the same facts in the
header."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from mrgs.baselines.thermonerf.config import ThermoNerfConfig
from mrgs.baselines.thermonerf.frame import SceneFrame
from mrgs.baselines.thermonerf.model import ThermoNerf
from mrgs.baselines.thermonerf.step import NerfState, make_state, new_model
from mrgs.training.checkpoint import UNFIT, read, skipped_in_a_row_of, unfit, write
from mrgs.training.checkpoint_layout import below, require_like
from mrgs.training.facts import CheckpointFacts


def tensors_of(state: NerfState) -> dict[str, Tensor]:
    """All tensors of a training, by name."""
    frame = state.model.frame
    tensors = {f"model.{name}": tensor for name, tensor in state.model.state_dict().items()}
    moments = state.optimizer.moments(dict(state.model.named_parameters()))
    tensors |= {f"adam.{name}": tensor for name, tensor in moments.items()}
    tensors["generator"] = state.generator.get_state()
    tensors["frame.centre"] = frame.centre
    tensors["frame.sizes"] = torch.tensor(
        [frame.radius, frame.near, frame.middle, frame.far], dtype=torch.float64
    )
    return tensors


def save(path: Path, state: NerfState, facts: CheckpointFacts) -> None:
    """Write everything needed to resume exactly, in one file that is either whole or not there.

    Raises:
        NotFiniteError: the state holds a NaN or an infinity; nothing is written.
        RunError: the file cannot be written.
    """
    write(path, tensors_of(state), facts, state.skipped_in_a_row)


def load_model(path: Path, config: ThermoNerfConfig) -> tuple[ThermoNerf, CheckpointFacts]:
    """The model of a checkpoint, to render with.

    Raises:
        DamagedCheckpointError: it is not what was written, or not finite.
        RunError: it cannot be read, is of another format, or not of this configuration.
    """
    tensors, facts, _ = read(path)
    try:
        return _model(tensors, config), facts
    except UNFIT as error:
        raise unfit(path, error) from error


def load_state(path: Path, config: ThermoNerfConfig) -> NerfState:
    """Everything in a checkpoint, to train on.

    Raises:
        DamagedCheckpointError: it is not what was written, or not finite.
        RunError: it cannot be read, is of another format, or not of this configuration.
    """
    tensors, facts, header = read(path)
    try:
        generator = torch.Generator()
        generator.set_state(tensors["generator"])
        state = make_state(_model(tensors, config), config, generator)
        parameters = dict(state.model.named_parameters())
        state.optimizer.load_moments(parameters, below(tensors, "adam."))
        state.step, state.skipped_in_a_row = facts.step, skipped_in_a_row_of(header)
        require_like(tensors, tensors_of(state))
    except UNFIT as error:
        raise unfit(path, error) from error
    return state


def _model(tensors: Mapping[str, Tensor], config: ThermoNerfConfig) -> ThermoNerf:
    """The model of a checkpoint.

    Raises:
        KeyError, ValueError: the tensors are not those of a model of this configuration.
    """
    frame = below(tensors, "frame.")
    numbers = {"centre": (3,), "sizes": (4,)}
    require_like(
        frame,
        {name: torch.empty(shape, dtype=torch.float64) for name, shape in numbers.items()},
    )
    radius, near, middle, far = frame["sizes"].tolist()
    if not (0 < radius < math.inf and 0 <= near < far < math.inf and 0 < middle < math.inf):
        raise ValueError("the frame has no size")
    model = new_model(config, SceneFrame(frame["centre"], radius, near, middle, far))
    layers = below(tensors, "model.")
    require_like(layers, model.state_dict())
    model.load_state_dict(layers)
    return model
