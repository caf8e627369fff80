"""One training step: the paper's algorithm from the photos of a view to the moved parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.method.config import TrainConfig
from mrgs.method.density import DensityStep
from mrgs.method.losses.photometric import total_loss
from mrgs.method.losses.term import LossContext, SceneScale
from mrgs.method.losses.terms import term_values
from mrgs.render import render, renderer
from mrgs.scene import THERMAL, Modality, Pixels, Rendering, View
from mrgs.training.resolution import coarser, pixel_sizes
from mrgs.training.state import TrainingState
from mrgs.training.view_sums import LOSS, THERMAL_ERROR, ViewSums

SumOverProcesses: TypeAlias = Callable[[TrainingState, ViewSums], ViewSums]
"""Adds to the gradients and measurements of a process those of all others."""


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


class PhotographedView(NamedTuple):
    """A training view with its photos.

    Attributes:
        number: its place among the training views.
        view: the view.
        photos: of it, by modality.
    """

    number: int
    view: View
    photos: Mapping[Modality, Pixels]


class StepResult(NamedTuple):
    """A step that has moved the parameters, before density control.

    Attributes:
        statistics: what it measured.
        observed: what the strategy has observed, summed over the views.
        finite: whether it counted; on the device.
    """

    statistics: StepStatistics
    observed: Mapping[str, Float[Tensor, " n"]]
    finite: Bool[Tensor, ""]


def training_step(
    state: TrainingState,
    views: Sequence[PhotographedView],
    config: TrainConfig,
    scale: SceneScale,
    sum_up: SumOverProcesses | None = None,
) -> StepResult:
    """Render views, compare them with their photos, move the parameters once.

    A step whose loss or gradients are not finite moves nothing. On a GPU that is decided there:
    the host does not wait.

    Args:
        state: changed in place.
        views: those that this process renders; without others, the ``batch`` of the configuration.
        config: of the run.
        scale: of the scene.
        sum_up: adds what other processes have found in other views.
    """
    state.step += 1
    state.model.sh_degree = config.sh_degree_at(state.step)
    state.refresh_neighbours(config)

    found = ViewSums()
    for each in views:
        _backward(state, each, config, scale, found)
    if sum_up is not None:
        found = sum_up(state, found)
    state.scale_gradients(1 / config.batch)

    loss = found.mean(LOSS)
    assert loss is not None
    finite = state.gradients_are_finite(loss)
    skipped_in_a_row = (state.skipped_in_a_row + 1) * ~finite
    error, count = found.mean(THERMAL_ERROR), len(state.model.gaussians)
    statistics = StepStatistics(state.step, loss, found.terms, error, count, ~finite)
    # Nothing has changed so far, so that a step for which memory does not suffice can be repeated.
    state.move(config, finite)
    for number, residual in found.residuals.items():
        state.image_model.learn_drift(number, residual, finite)
    state.skipped_in_a_row = skipped_in_a_row
    return StepResult(statistics, found.observed, finite)


def _backward(
    state: TrainingState,
    each: PhotographedView,
    config: TrainConfig,
    scale: SceneScale,
    found: ViewSums,
) -> None:
    """Add the gradients of a view's loss to those of the parameters, and what it measured to what
    was found."""
    view = each.view
    degrees = {THERMAL: config.temperature_sh_degree_at(state.step)}
    cameras, photos = coarser(view.cameras, each.photos, config.pixel_size_at(state.step))
    rendering, passes = render(state.model, cameras, degrees)
    observed = state.image_model(rendering, each.number, pixel_sizes(view.cameras, cameras))
    context = LossContext(
        rendering,
        observed,
        photos,
        cameras,
        state.model.gaussians,
        state.model.dilation,
        scale,
        renderer(state.model, degrees),
    )
    values = term_values([term for term in state.terms if term.is_due(state.step)], context)
    loss = total_loss(values, {term.name: term.weight(state.step) for term in state.terms})
    loss.backward()
    error = _thermal_error(observed, photos)
    found.add(loss, values, error, state.strategy.observe(passes))
    if THERMAL in photos:
        residual = state.image_model.thermal_residual(each.number, observed, photos[THERMAL])
        if residual is not None:
            found.residuals[each.number] = residual


def control_density(
    state: TrainingState, result: StepResult, config: TrainConfig, extent: float
) -> Mapping[str, int] | None:
    """Let the strategy adapt the Gaussians after a step.

    Where a GPU's memory does not suffice, nothing has changed.

    Args:
        state: changed in place.
        result: of the step.
        config: of the run.
        extent: of the scene.

    Returns:
        the strategy's counts for the log; None where it has left the rows as they are.
    """
    strategy, before = state.strategy, state.model.gaussians.means
    observed = {
        name: torch.where(result.finite, value, 0) for name, value in result.observed.items()
    }
    step = DensityStep(
        state.step, extent, config.distant_points, observed, result.finite, state.generator
    )
    update = strategy.after_step(state.strategy_state, state.gaussian_optimizer, step)
    state.strategy_state = update.state
    if state.model.gaussians.means is not before:
        state.model.neighbours = None
    return update.counts


def _thermal_error(
    rendering: Rendering, photos: Mapping[Modality, Pixels]
) -> Float[Tensor, ""] | None:
    """Mean absolute error of the normalised temperature over the valid pixels; NaN if there are
    none."""
    if THERMAL not in photos:
        return None
    error = (rendering[THERMAL].image.detach() - photos[THERMAL].values).abs()
    valid = photos[THERMAL].valid
    return (
        error.mean()
        if valid is None
        else torch.where(valid[:, :, None], error, 0).sum() / valid.sum()
    )
