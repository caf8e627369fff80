"""One training step: the paper's algorithm from the photos of a view to the moved parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch

from mrgs.field import nearest_neighbours
from mrgs.render import Model, Rendering, render
from mrgs.scene import View
from mrgs.training.config import TrainConfig
from mrgs.training.densification import DensificationConfig, DensificationCounts, ScreenStatistics, densify
from mrgs.training.image_model import ImageModel
from mrgs.training.losses import total_loss
from mrgs.training.optimizer import GaussianOptimizer, set_rates
from mrgs.training.radiation import DepthUncertainty
from mrgs.training.relocation import RelocationConfig, RelocationCounts, explore, relocate, sparsity_loss
from mrgs.training.terms import Photos, SceneScale, loss_terms, loss_weights
from mrgs.training.views import ViewSampler


@dataclass
class TrainingState:
    """All that changes during training, and so all that a checkpoint must hold.

    Attributes:
        step: steps done.
        model: what is trained; its Gaussians are those of ``gaussian_optimizer``.
        uncertainty: ψ of L_boltz.
        image_model: what the cameras do to the images.
        gaussian_optimizer: Adam over the Gaussians.
        layer_optimizer: Adam over the field's layers, ψ and the image model.
        statistics: of the screen-space gradients since the last densification.
        sampler: the order of the views.
        generator: of every random choice after the start.
        skipped_in_a_row: steps skipped since the last good one, because of a value that was not finite.
    """

    step: int
    model: Model
    uncertainty: DepthUncertainty
    image_model: ImageModel
    gaussian_optimizer: GaussianOptimizer
    layer_optimizer: torch.optim.Adam
    statistics: ScreenStatistics
    sampler: ViewSampler
    generator: torch.Generator
    skipped_in_a_row: int = 0


class StepStatistics(NamedTuple):
    """What a step measured.

    Attributes:
        step: its number, from 1.
        loss: L_total; not finite if the step was skipped.
        terms: L_c ("rgb"), L_t ("thermal"), L_smooth, L_boltz, unweighted.
        thermal_error: mean absolute error of the normalised temperature on the training view; None without one.
        gaussians: N.
        skipped: the loss or a gradient was not finite, so nothing was changed.
    """

    step: int
    loss: float
    terms: dict[str, float]
    thermal_error: float | None
    gaussians: int
    skipped: bool


def training_step(
    state: TrainingState,
    view: View,
    number: int,
    photos: Photos,
    config: TrainConfig,
    scale: SceneScale,
) -> StepStatistics:
    """Render a view, compare it with its photos, move the parameters.

    Args:
        state: changed in place.
        view: a training view.
        number: its place among the training views.
        photos: of the view.
        config: of the run.
        scale: of the scene.
    """
    state.step += 1
    model = state.model
    model.sh_degree = config.sh_degree_at(state.step)
    _refresh_neighbours(state, config)

    rendering, passes = render(
        model,
        view.rgb.camera if view.rgb else None,
        view.thermal.camera if view.thermal else None,
        state.image_model.thermal_motion(number),
    )
    photographed = state.image_model(rendering, number)
    terms = loss_terms(rendering, photographed, photos, config, scale, state.uncertainty)
    loss = total_loss(terms, loss_weights(config, state.step))
    if config.relocation is not None:
        loss = loss + sparsity_loss(model.gaussians, scale.extent, config.relocation)
    loss.backward()

    skipped = not (bool(loss.isfinite()) and _gradients_are_finite(state))
    if skipped:
        state.skipped_in_a_row += 1
        state.gaussian_optimizer.zero_grad()
    else:
        state.skipped_in_a_row = 0
        state.statistics.add(passes)
        _move(state, config, scale.extent)
    state.layer_optimizer.zero_grad(set_to_none=True)
    return StepStatistics(
        step=state.step,
        loss=loss.item(),
        terms={name: term.item() for name, term in terms.items()},
        thermal_error=_thermal_error(photographed, photos),
        gaussians=len(model.gaussians),
        skipped=skipped,
    )


def _move(state: TrainingState, config: TrainConfig, extent: float) -> None:
    """Adam's step of all parameters, and the noise of relocation."""
    progress = state.step / config.max_steps
    state.gaussian_optimizer.step(progress)
    set_rates(state.layer_optimizer, config.optimizer.slowdown_at(progress))
    state.layer_optimizer.step()
    if config.relocation is not None:
        rate = config.optimizer.means_at(progress) * extent
        explore(state.model.gaussians, rate, config.relocation, state.generator)


def control_density(
    state: TrainingState, config: TrainConfig, extent: float
) -> DensificationCounts | RelocationCounts | None:
    """Add, remove or move Gaussians and reset opacities where the schedule says so; None if rows stay as they are."""
    counts: DensificationCounts | RelocationCounts | None
    if config.relocation is not None:
        counts = _relocate(state, config.relocation, config.densification.max_gaussians)
    else:
        counts = _densify(state, config.densification, extent)
    if counts is not None:
        state.statistics = ScreenStatistics.empty(len(state.model.gaussians))
        state.model.neighbours = None
    return counts


def _relocate(state: TrainingState, schedule: RelocationConfig, budget: int) -> RelocationCounts | None:
    if not schedule.relocates_at(state.step):
        return None
    return relocate(state.gaussian_optimizer, schedule, state.step, budget, state.generator)


def _densify(state: TrainingState, schedule: DensificationConfig, extent: float) -> DensificationCounts | None:
    counts = None
    if schedule.densifies_at(state.step):
        prunes_large = state.step > schedule.reset_every
        counts = densify(state.gaussian_optimizer, state.statistics, schedule, extent, prunes_large, state.generator)
    if schedule.resets_at(state.step):
        state.gaussian_optimizer.limit_opacities(schedule.reset_opacity)
    return counts


def _refresh_neighbours(state: TrainingState, config: TrainConfig) -> None:
    """Search the neighbours anew when N has changed, and every so many steps because the Gaussians move."""
    k = config.field.neighbours_k
    if k > 0 and (state.model.neighbours is None or state.step % config.neighbours_every == 0):
        state.model.neighbours = nearest_neighbours(state.model.gaussians.means, k)


def _gradients_are_finite(state: TrainingState) -> bool:
    layers = [parameter for group in state.layer_optimizer.param_groups for parameter in group["params"]]
    return state.gaussian_optimizer.gradients_are_finite() and all(
        bool(parameter.grad.isfinite().all()) for parameter in layers if parameter.grad is not None
    )


def _thermal_error(rendering: Rendering, photos: Photos) -> float | None:
    """Mean absolute error of the normalised temperature over the valid pixels."""
    if rendering.thermal is None or photos.thermal is None:
        return None
    error = (rendering.thermal.detach() - photos.thermal.values).abs()
    counted = error if photos.thermal.valid is None else error[photos.thermal.valid]
    return counted.mean().item() if counted.numel() > 0 else None
