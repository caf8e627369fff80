"""Checkpoints in the form of ``mrgs.training.checkpoint``: safetensors with the same facts in the
header."""

from __future__ import annotations

import json
from pathlib import Path

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor

from mrgs.baselines.thermonerf.config import ThermoNerfConfig
from mrgs.baselines.thermonerf.frame import SceneFrame
from mrgs.baselines.thermonerf.model import ThermoNerf
from mrgs.baselines.thermonerf.step import NerfState, make_state, new_model
from mrgs.errors import RunError
from mrgs.training.checkpoint import CheckpointFacts, load_facts, write


def save(path: Path, state: NerfState, facts: CheckpointFacts) -> None:
    """Write everything needed to resume exactly, in one file that is either whole or
    not there.

    Raises:
        RunError: the file cannot be written.
    """
    frame = state.model.frame
    tensors = {f"model.{name}": tensor for name, tensor in state.model.state_dict().items()}
    for name, parameter in state.model.named_parameters():
        moments = state.optimizer.state.get(parameter, {})
        tensors |= {f"adam.{key}.{name}": value for key, value in moments.items()}
    tensors["generator"] = state.generator.get_state()
    tensors["frame.centre"] = frame.centre
    tensors["frame.sizes"] = torch.tensor(
        [frame.radius, frame.near, frame.middle, frame.far], dtype=torch.float64
    )
    write(path, tensors, facts, state.skipped_in_a_row)


def load_model(path: Path, config: ThermoNerfConfig) -> tuple[ThermoNerf, CheckpointFacts]:
    """The model of a checkpoint, to render with.

    Raises:
        RunError: not a whole checkpoint of this format, or not of this configuration.
    """
    facts, tensors = load_facts(path), _read(path)
    return _model(path, tensors, config), facts


def load_state(path: Path, config: ThermoNerfConfig) -> NerfState:
    """Everything in a checkpoint, to train on.

    Raises:
        RunError: not a whole checkpoint of this format, or not of this configuration.
    """
    facts, tensors = load_facts(path), _read(path)
    model = _model(path, tensors, config)
    try:
        generator = torch.Generator()
        generator.set_state(tensors["generator"])
        state = make_state(model, config, generator)
        state.step, state.skipped_in_a_row = facts.step, _skipped_in_a_row(path)
        for name, parameter in model.named_parameters():
            if f"adam.step.{name}" in tensors:
                keys = ("step", "exp_avg", "exp_avg_sq")
                moments = {key: tensors[f"adam.{key}.{name}"] for key in keys}
                if (
                    moments["exp_avg"].shape != parameter.shape
                    or moments["exp_avg_sq"].shape != parameter.shape
                ):
                    raise ValueError("the moments are not those of the parameter")
                state.optimizer.state[parameter] = moments
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise _mismatch(path) from error
    return state


def _read(path: Path) -> dict[str, Tensor]:
    try:
        tensors: dict[str, Tensor] = safetensors.torch.load_file(path)
    except (SafetensorError, OSError, ValueError) as error:
        raise RunError(
            f"{path} is not a whole checkpoint: delete it, and the one before it is used; without "
            f"one, retrain"
        ) from error
    return tensors


def _skipped_in_a_row(path: Path) -> int:
    with safetensors.safe_open(path, framework="pt") as file:
        return int(json.loads((file.metadata() or {})["mrgs"])["skipped_in_a_row"])


def _model(path: Path, tensors: dict[str, Tensor], config: ThermoNerfConfig) -> ThermoNerf:
    try:
        radius, near, middle, far = tensors["frame.sizes"].tolist()
        if not (
            radius > 0 and 0 <= near < far and middle > 0 and tensors["frame.centre"].shape == (3,)
        ):
            raise ValueError("the frame has no size")
        model = new_model(config, SceneFrame(tensors["frame.centre"], radius, near, middle, far))
        prefix = "model."
        model.load_state_dict(
            {
                name.removeprefix(prefix): tensor
                for name, tensor in tensors.items()
                if name.startswith(prefix)
            }
        )
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise _mismatch(path) from error
    return model


def _mismatch(path: Path) -> RunError:
    return RunError(
        f"{path} does not fit the run's config.yaml: restore the configuration it was trained with"
    )
