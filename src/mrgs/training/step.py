"""One training step: the paper's algorithm from the photos of a view to the moved parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from mrgs.field import nearest_neighbours
from mrgs.method.camera_model.image_model import ImageModel
from mrgs.method.config import TrainConfig
from mrgs.method.density.densification import DensificationCounts, ScreenStatistics, densify
from mrgs.method.density.relocation import (
    RelocationConfig,
    RelocationCounts,
    explore,
    relocate,
    sparsity_loss,
)
from mrgs.method.losses.photometric import total_loss
from mrgs.method.losses.radiation import DepthUncertainty
from mrgs.method.losses.terms import Photos, SceneScale, loss_terms, loss_weights
from mrgs.method.optimizer import GaussianOptimizer, are_finite, set_rates, step_if
from mrgs.render import Model, Rendering, render
from mrgs.scene import View
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
        skipped_in_a_row: steps skipped since the last good one, because of a value that was not
            finite; on the model's device.
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
    skipped_in_a_row: Int64[Tensor, ""] = field(
        default_factory=lambda: torch.zeros((), dtype=torch.int64)
    )

    @property
    def device(self) -> torch.device:
        """Where it is, but for the order of the views and the generator, which stay with the
        host."""
        return self.model.gaussians.means.device

    def go_back(self, step: int, generator: Tensor, waiting: Tensor) -> None:
        """Undo a step that was broken off before it moved anything.

        Args:
            step: what ``step`` was before it.
            generator: state of the generator.
            waiting: state of the sampler.
        """
        self.step = step
        self.generator.set_state(generator)
        self.sampler.load(waiting)
        self.gaussian_optimizer.zero_grad()
        self.layer_optimizer.zero_grad(set_to_none=True)


class StepStatistics:
    """What a step measured. On a GPU the numbers are fetched when the first of them is asked for,
    which waits for it.

    Attributes:
        step: its number, from 1.
        gaussians: N.
    """

    def __init__(
        self,
        step: int,
        loss: float | Float[Tensor, ""],
        terms: Mapping[str, float | Float[Tensor, ""]],
        thermal_error: float | Float[Tensor, ""] | None,
        gaussians: int,
        skipped: bool | Tensor,
    ) -> None:
        self.step = step
        self.gaussians = gaussians
        self._names = tuple(terms)
        error = math.nan if thermal_error is None else thermal_error
        self._measured = _together([loss, skipped, error, *terms.values()])

    @property
    def loss(self) -> float:
        """L_total; not finite if the step was skipped for it."""
        return self._read()[0]

    @property
    def skipped(self) -> bool:
        """The loss or a gradient was not finite, so nothing was changed."""
        return bool(self._read()[1])

    @property
    def thermal_error(self) -> float | None:
        """Mean absolute error of the normalised temperature on the training view; None without
        one."""
        error = self._read()[2]
        return None if math.isnan(error) else error

    @property
    def terms(self) -> dict[str, float]:
        """L_c ("rgb"), L_t ("thermal"), L_smooth, L_boltz, unweighted."""
        return dict(zip(self._names, self._read()[3:], strict=True))

    def _read(self) -> list[float]:
        if isinstance(self._measured, Tensor):
            self._measured = self._measured.tolist()
        return self._measured


def _together(numbers: Sequence[float | Tensor]) -> Tensor | list[float]:
    """Numbers as one tensor, so that they are fetched at once, where any of them is a tensor."""
    tensors = [number for number in numbers if isinstance(number, Tensor)]
    if not tensors:
        return [float(number) for number in numbers]
    like = tensors[0].detach()
    return torch.stack(
        [
            n.detach().to(like) if isinstance(n, Tensor) else torch.full_like(like, n)
            for n in numbers
        ]
    )


def training_step(
    state: TrainingState,
    view: View,
    number: int,
    photos: Photos,
    config: TrainConfig,
    scale: SceneScale,
) -> StepStatistics:
    """Render a view, compare it with its photos, move the parameters.

    On a GPU the host waits for nothing: whether a step counts is decided there, and the statistics
    tell it when asked. Where its memory does not suffice nothing has moved yet, unless it was at
    the first step for Adam's moments, which torch makes one parameter after another.

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
        config.temperature_sh_degree_at(state.step),
    )
    photographed = state.image_model(rendering, number)
    terms = loss_terms(rendering, photographed, photos, config, scale, state.uncertainty)
    loss = total_loss(terms, loss_weights(config, state.step))
    if config.relocation is not None:
        loss = loss + sparsity_loss(model.gaussians, scale.extent, config.relocation)
    loss.backward()

    good = are_finite(loss, state.gaussian_optimizer.gradients() + _layer_gradients(state))
    skipped_in_a_row = (state.skipped_in_a_row + 1) * ~good
    screen_statistics = state.statistics.copy()
    screen_statistics.add(passes, good)
    measured = StepStatistics(
        step=state.step,
        loss=loss,
        terms=terms,
        thermal_error=_thermal_error(photographed, photos),
        gaussians=len(model.gaussians),
        skipped=~good,
    )
    # Above is all that needs memory, so that a step for which it does not suffice can be repeated.
    _move(state, config, good)
    state.statistics, state.skipped_in_a_row = screen_statistics, skipped_in_a_row
    return measured


def _move(state: TrainingState, config: TrainConfig, good: Bool[Tensor, ""]) -> None:
    """Adam's step of all parameters; nothing where the step is not good."""
    progress = state.step / config.max_steps
    state.gaussian_optimizer.step(progress, good)
    set_rates(state.layer_optimizer, config.optimizer.slowdown_at(progress))
    step_if(good, state.layer_optimizer)
    state.layer_optimizer.zero_grad(set_to_none=True)


def explore_means(state: TrainingState, config: TrainConfig, extent: float) -> None:
    """The noise of relocation, where a run has it, after a step; nothing where the step was not
    good.

    It depends on where the step has moved the Gaussians, and is apart from it so that each can be
    repeated alone where a GPU's memory does not suffice.
    """
    if config.relocation is None:
        return
    rate = config.optimizer.means_at(state.step / config.max_steps) * extent
    explore(
        state.model.gaussians, rate, config.relocation, state.generator, state.skipped_in_a_row == 0
    )


def changes_density(config: TrainConfig, step: int) -> bool:
    """Whether ``control_density`` has something to do after this step."""
    if config.relocation is not None:
        return config.relocation.relocates_at(step)
    return config.densification.densifies_at(step) or config.densification.resets_at(step)


def control_density(
    state: TrainingState, config: TrainConfig, extent: float
) -> DensificationCounts | RelocationCounts | None:
    """Add, remove or move Gaussians and reset opacities where the schedule says so; None if rows
    stay as they are.

    Where a GPU's memory does not suffice, nothing has changed.
    """
    counts: DensificationCounts | RelocationCounts | None
    if config.relocation is not None:
        counts = _relocate(state, config.relocation, config.densification.max_gaussians)
    else:
        counts = _densify(state, config, extent)
    if counts is not None:
        state.statistics.clear()
        state.model.neighbours = None
    return counts


def _relocate(
    state: TrainingState, schedule: RelocationConfig, budget: int
) -> RelocationCounts | None:
    if not schedule.relocates_at(state.step):
        return None
    return relocate(
        state.gaussian_optimizer, schedule, state.step, budget, state.generator, state.statistics
    )


def _densify(
    state: TrainingState, config: TrainConfig, extent: float
) -> DensificationCounts | None:
    counts, schedule = None, config.densification
    if schedule.densifies_at(state.step):
        prunes_large = (
            state.step > schedule.reset_every and not config.distant_points
        )  # the sky is large
        counts = densify(
            state.gaussian_optimizer,
            state.statistics,
            schedule,
            extent,
            prunes_large,
            state.generator,
        )
    if schedule.resets_at(state.step):
        state.gaussian_optimizer.limit_opacities(schedule.reset_opacity)
    return counts


def _refresh_neighbours(state: TrainingState, config: TrainConfig) -> None:
    """Search the neighbours anew when N has changed, and every so many steps because the Gaussians
    move."""
    k = config.field.neighbours_k
    if k > 0 and (state.model.neighbours is None or state.step % config.neighbours_every == 0):
        state.model.neighbours = nearest_neighbours(state.model.gaussians.means, k)


def _layer_gradients(state: TrainingState) -> list[Tensor]:
    """Of the field's layers, ψ and the image model, as far as the view had any."""
    layers = [
        parameter for group in state.layer_optimizer.param_groups for parameter in group["params"]
    ]
    return [parameter.grad for parameter in layers if parameter.grad is not None]


def _thermal_error(rendering: Rendering, photos: Photos) -> Float[Tensor, ""] | None:
    """Mean absolute error of the normalised temperature over the valid pixels; NaN if there are
    none."""
    if rendering.thermal is None or photos.thermal is None:
        return None
    error = (rendering.thermal.detach() - photos.thermal.values).abs()
    valid = photos.thermal.valid
    return (
        error.mean()
        if valid is None
        else torch.where(valid[:, :, None], error, 0).sum() / valid.sum()
    )
