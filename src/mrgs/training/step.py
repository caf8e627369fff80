"""One training step: the paper's algorithm from the photos of a view to the moved parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.method.config import TrainConfig
from mrgs.method.density import DensityStep
from mrgs.method.losses.photometric import total_loss
from mrgs.method.losses.term import LossContext, SceneScale
from mrgs.method.losses.terms import term_values
from mrgs.render import ScreenPoints, render, renderer
from mrgs.scene import THERMAL, Modality, Pixels, Rendering, View
from mrgs.training.resolution import coarser, pixel_sizes
from mrgs.training.state import TrainingState


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


class StepResult(NamedTuple):
    """A step that has moved the parameters, before density control.

    Attributes:
        statistics: what it measured.
        passes: projected centres of the view's passes, with their gradients.
        finite: whether it counted; on the device.
    """

    statistics: StepStatistics
    passes: list[ScreenPoints]
    finite: Bool[Tensor, ""]


def training_step(
    state: TrainingState,
    view: View,
    number: int,
    photos: Mapping[Modality, Pixels],
    config: TrainConfig,
    scale: SceneScale,
) -> StepResult:
    """Render a view, compare it with its photos, move the parameters.

    A step whose loss or gradients are not finite moves nothing. On a GPU that is decided there:
    the host does not wait.

    Args:
        state: changed in place.
        view: a training view.
        number: its place among the training views.
        photos: of the view, by modality.
        config: of the run.
        scale: of the scene.
    """
    state.step += 1
    state.model.sh_degree = config.sh_degree_at(state.step)
    state.refresh_neighbours(config)

    degrees = {THERMAL: config.temperature_sh_degree_at(state.step)}
    cameras, photos = coarser(view.cameras, photos, config.pixel_size_at(state.step))
    rendering, passes = render(state.model, cameras, degrees)
    observed = state.image_model(rendering, number, pixel_sizes(view.cameras, cameras))
    context = LossContext(
        rendering,
        observed,
        photos,
        cameras,
        state.model.gaussians,
        scale,
        renderer(state.model, degrees),
    )
    values = term_values(state.terms, context)
    loss = total_loss(values, {term.name: term.weight(state.step) for term in state.terms})
    loss.backward()

    finite = state.gradients_are_finite(loss)
    skipped_in_a_row = (state.skipped_in_a_row + 1) * ~finite
    error = _thermal_error(observed, photos)
    statistics = StepStatistics(
        state.step, loss, values, error, len(state.model.gaussians), ~finite
    )
    # Nothing has changed so far, so that a step for which memory does not suffice can be repeated.
    state.move(config, finite)
    if THERMAL in photos:
        state.image_model.learn_drift(number, observed, photos[THERMAL], finite)
    state.skipped_in_a_row = skipped_in_a_row
    return StepResult(statistics, passes, finite)


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
    passes = (
        [_only_if(result.finite, points) for points in result.passes]
        if strategy.needs_screen_gradients
        else []
    )
    step = DensityStep(
        state.step, extent, config.distant_points, passes, result.finite, state.generator
    )
    update = strategy.after_step(state.strategy_state, state.gaussian_optimizer, step)
    state.strategy_state = update.state
    if state.model.gaussians.means is not before:
        state.model.neighbours = None
    return update.counts


def _only_if(finite: Bool[Tensor, ""], points: ScreenPoints) -> ScreenPoints:
    """The projected centres of a pass; without gradients, and none of them drawn, if the step was
    skipped."""
    offset = points.offset.detach()
    if points.offset.grad is not None:
        offset.grad = torch.where(finite, points.offset.grad, 0)
    return points._replace(offset=offset, radii=torch.where(finite, points.radii, 0))


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
