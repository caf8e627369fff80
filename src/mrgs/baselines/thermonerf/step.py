"""One training step: a batch of rays from the photos to the moved parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from mrgs.baselines.thermonerf.config import ThermoNerfConfig
from mrgs.baselines.thermonerf.frame import SceneFrame, frame_of
from mrgs.baselines.thermonerf.losses import distortion_loss, interlevel_loss, squared_error
from mrgs.baselines.thermonerf.model import ThermoNerf, Traced
from mrgs.baselines.thermonerf.pixels import Batch, PixelPool
from mrgs.method.adam import Adam, ParameterGroup
from mrgs.method.optimizer import are_finite
from mrgs.scene import THERMAL, Scene
from mrgs.system.torch_modes import seeded

ADAM_EPSILON = 1e-15
"""Entries of the hash tables get rare and tiny gradients (Müller et al. 2022, Section 4)."""


@dataclass
class NerfState:
    """All that changes during training, and so all that a checkpoint must hold.

    Attributes:
        step: steps done.
        model: what is trained.
        optimizer: Adam over all its parameters.
        generator: of every random choice after the start.
        skipped_in_a_row: steps skipped since the last good one, because of a value that was not
            finite.
    """

    step: int
    model: ThermoNerf
    optimizer: Adam
    generator: torch.Generator
    skipped_in_a_row: int = 0


class ThermoNerfStatistics(NamedTuple):
    """The measurements of one training step.

    Attributes:
        step: its number, from 1.
        loss: the weighted sum of the terms; not finite if the step was skipped.
        terms: squared error of each modality by its name, "interlevel" and "distortion",
            unweighted.
        thermal_error: mean absolute error of the normalised temperature over the batch; None
            without one.
        skipped: the loss or a gradient was not finite, so nothing was changed.
        gaussians: always None: the method has none.
    """

    step: int
    loss: float
    terms: dict[str, float]
    thermal_error: float | None
    skipped: bool
    gaussians: None = None


def initial_state(scene: Scene, config: ThermoNerfConfig) -> NerfState:
    """The state at step 0; every random choice follows from the seed, and torch's own generator is
    left alone."""
    return make_state(
        new_model(config, frame_of(scene)), config, torch.Generator().manual_seed(config.seed)
    )


def new_model(config: ThermoNerfConfig, frame: SceneFrame) -> ThermoNerf:
    """An untrained model."""
    with seeded(config.seed):
        return ThermoNerf(config, frame)


def make_state(
    model: ThermoNerf, config: ThermoNerfConfig, generator: torch.Generator
) -> NerfState:
    """A state at step 0: a fresh optimizer around a model."""
    parameters = ParameterGroup(list(model.parameters()), config.learning_rate)
    optimizer = Adam([parameters], epsilon=ADAM_EPSILON)
    return NerfState(0, model, optimizer, generator)


def training_step(
    state: NerfState, pool: PixelPool, config: ThermoNerfConfig
) -> ThermoNerfStatistics:
    """Draw rays, compare what they see with the photos, move the parameters; ``state`` is changed
    in place."""
    state.step += 1
    batch = pool.draw(config.rays_per_batch, state.generator)
    rows = {modality: target.rows for modality, target in batch.targets.items()}
    traced = state.model.trace(batch.rays, rows, state.generator)
    terms = loss_terms(traced, batch)
    weights = {"interlevel": config.loss.interlevel, "distortion": config.loss.distortion}
    loss = torch.stack([weights.get(name, 1.0) * term for name, term in terms.items()]).sum()
    loss.backward()

    gradients = [each.grad for each in state.model.parameters() if each.grad is not None]
    skipped = not bool(are_finite(loss, gradients))
    if skipped:
        state.skipped_in_a_row += 1
    else:
        state.skipped_in_a_row = 0
        for group in state.optimizer.groups:
            group.rate = config.learning_rate_at(state.step)
        state.optimizer.step()
    state.optimizer.zero_grad()
    return ThermoNerfStatistics(
        step=state.step,
        loss=loss.item(),
        terms={name: term.item() for name, term in terms.items()},
        thermal_error=_thermal_error(traced, batch),
        skipped=skipped,
    )


def loss_terms(traced: Traced, batch: Batch) -> dict[str, Tensor]:
    """The squared error of each modality of the batch, and the two terms on the weights."""
    terms = {
        modality.name: squared_error(traced.values[modality], target.values, target.valid)
        for modality, target in batch.targets.items()
    }
    terms["interlevel"] = interlevel_loss(*traced.samples)
    terms["distortion"] = distortion_loss(traced.samples.edges, traced.samples.weights)
    return terms


def _thermal_error(traced: Traced, batch: Batch) -> float | None:
    """Mean absolute error of the normalised temperature over the valid rays."""
    if THERMAL not in batch.targets:
        return None
    target = batch.targets[THERMAL]
    error = (traced.values[THERMAL].detach() - target.values).abs()
    counted = error if target.valid is None else error[target.valid]
    return counted.mean().item() if counted.numel() > 0 else None
