"""One training step: the paper's algorithm from the photos of a view to the moved parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from mrgs.field import nearest_neighbours
from mrgs.render import Model, Rendering, render
from mrgs.scene import Pixels, TemperatureRange, View
from mrgs.training.config import TrainConfig
from mrgs.training.densification import DensificationCounts, ScreenStatistics, densify
from mrgs.training.losses import photometric_loss, smoothness_loss, total_loss
from mrgs.training.optimizer import GaussianOptimizer
from mrgs.training.radiation import (
    DepthUncertainty,
    boltzmann_loss,
    boltzmann_weight,
    normalise_radiation,
    thermal_radiation,
)
from mrgs.training.views import ViewSampler


@dataclass
class TrainingState:
    """All that changes during training, and so all that a checkpoint must hold.

    Attributes:
        step: steps done.
        model: what is trained; its Gaussians are those of ``gaussian_optimizer``.
        uncertainty: ψ of L_boltz.
        gaussian_optimizer: Adam over the Gaussians.
        layer_optimizer: Adam over the field's layers and ψ.
        statistics: of the screen-space gradients since the last densification.
        sampler: the order of the views.
        generator: of every random choice after the start.
        skipped_in_a_row: steps skipped since the last good one, because of a value that was not finite.
    """

    step: int
    model: Model
    uncertainty: DepthUncertainty
    gaussian_optimizer: GaussianOptimizer
    layer_optimizer: torch.optim.Adam
    statistics: ScreenStatistics
    sampler: ViewSampler
    generator: torch.Generator
    skipped_in_a_row: int = 0


class Photos(NamedTuple):
    """A view's photos; None for a modality that the view lacks."""

    rgb: Pixels | None
    thermal: Pixels | None


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
    photos: Photos,
    config: TrainConfig,
    extent: float,
    temperature: TemperatureRange | None,
) -> StepStatistics:
    """Render the view, compare it with its photos, move the parameters; ``state`` is changed in place."""
    state.step += 1
    model = state.model
    model.sh_degree = config.sh_degree_at(state.step)
    _refresh_neighbours(state, config)

    rendering, passes = render(
        model, view.rgb.camera if view.rgb else None, view.thermal.camera if view.thermal else None
    )
    terms = loss_terms(rendering, photos, config, extent, temperature, state.uncertainty)
    weight = boltzmann_weight(state.step, config.radiation) if config.radiation else 0.0
    loss = total_loss(terms, config.loss.smooth, weight)
    loss.backward()

    skipped = not (bool(loss.isfinite()) and _gradients_are_finite(state))
    if skipped:
        state.skipped_in_a_row += 1
        state.gaussian_optimizer.zero_grad()
    else:
        state.skipped_in_a_row = 0
        state.statistics.add(passes)
        state.gaussian_optimizer.step(state.step / config.max_steps)
        state.layer_optimizer.step()
    state.layer_optimizer.zero_grad(set_to_none=True)
    return StepStatistics(
        step=state.step,
        loss=loss.item(),
        terms={name: term.item() for name, term in terms.items()},
        thermal_error=_thermal_error(rendering, photos),
        gaussians=len(model.gaussians),
        skipped=skipped,
    )


def loss_terms(
    rendering: Rendering,
    photos: Photos,
    config: TrainConfig,
    extent: float,
    temperature: TemperatureRange | None,
    uncertainty: DepthUncertainty,
) -> dict[str, Tensor]:
    """L_c, L_t, L_smooth and L_boltz of a view, as far as the view and the method have them."""
    terms: dict[str, Tensor] = {}
    smooth = []
    for name, image, depth, photo in (
        ("rgb", rendering.rgb, rendering.depth_rgb, photos.rgb),
        ("thermal", rendering.thermal, rendering.depth_thermal, photos.thermal),
    ):
        if image is not None and depth is not None and photo is not None:
            terms[name] = photometric_loss(image, photo.values, photo.valid, config.loss.dssim)
            if config.loss.smooth > 0:
                smooth.append(smoothness_loss(image, depth, photo.values, photo.valid, extent, config.loss))
    if smooth:
        terms["smooth"] = torch.stack(smooth).sum()
    if config.radiation is not None and "thermal" in terms:
        terms["boltzmann"] = _radiation_term(rendering, photos.thermal, extent, temperature, uncertainty)
    return terms


def _radiation_term(
    rendering: Rendering,
    photo: Pixels | None,
    extent: float,
    temperature: TemperatureRange | None,
    uncertainty: DepthUncertainty,
) -> Tensor:
    """L_boltz from the photo's temperatures and the rendered depth."""
    assert photo is not None
    assert rendering.thermal is not None
    assert rendering.depth_thermal is not None
    depth = rendering.depth_thermal
    radiation = thermal_radiation(photo.values[..., 0], depth, extent, temperature)
    radiation = normalise_radiation(radiation, photo.valid)
    return boltzmann_loss(rendering.thermal[..., 0], radiation, uncertainty(depth, extent), photo.valid)


def control_density(state: TrainingState, config: TrainConfig, extent: float) -> DensificationCounts | None:
    """Densify and reset opacities where the schedule says so; None if this step changes no rows."""
    schedule = config.densification
    counts = None
    if schedule.densifies_at(state.step):
        prunes_large = state.step > schedule.reset_every
        counts = densify(state.gaussian_optimizer, state.statistics, schedule, extent, prunes_large, state.generator)
        state.statistics = ScreenStatistics.empty(len(state.model.gaussians))
        state.model.neighbours = None
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
