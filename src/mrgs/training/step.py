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
from mrgs.method.losses.term import SceneScale
from mrgs.training.recorder import Recorder
from mrgs.training.state import TrainingState
from mrgs.training.view_pass import PhotographedView, forward_backward, view_inputs
from mrgs.training.view_sums import LOSS, THERMAL_ERROR, ViewSums


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
        """Every term of the loss by its name, unweighted."""
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
    recorder: Recorder | None = None,
) -> StepResult:
    """Render views, compare them with their photos, move the parameters once.

    A step whose loss or gradients are not finite moves nothing. On a GPU that is decided there:
    the host does not wait.

    Args:
        state: changed in place.
        views: the ``batch`` of the configuration.
        config: of the run.
        scale: of the scene.
        recorder: replays the pass of a step's only view on a GPU.
    """
    state.step += 1
    state.model.sh_degree = config.sh_degree_at(state.step)
    state.refresh_neighbours(config)
    if len(views) > 1:
        recorder = None
    while True:
        found = ViewSums()
        for each in views:
            _add_view(state, each, config, scale, found, recorder)
        result = _move(state, found, config, recorder)
        if recorder is None or recorder.had_room():
            break
    state.skipped_in_a_row = (state.skipped_in_a_row + 1) * ~result.finite
    return result


def _add_view(
    state: TrainingState,
    each: PhotographedView,
    config: TrainConfig,
    scale: SceneScale,
    found: ViewSums,
    recorder: Recorder | None,
) -> None:
    """Add the gradients of a view's loss to those of the parameters, and what it measured to what
    was found."""
    inputs = view_inputs(state, each, config)
    if recorder is None:
        measures = forward_backward(state, inputs, scale)
    else:
        measures = recorder.run(state, inputs, lambda given: forward_backward(state, given, scale))
    found.add(
        measures.loss,
        measures.terms,
        measures.thermal_error,
        state.strategy.observe(measures.passes),
    )
    if measures.residual is not None:
        found.residuals[each.number] = measures.residual


def _move(
    state: TrainingState, found: ViewSums, config: TrainConfig, recorder: Recorder | None
) -> StepResult:
    """Move the parameters by the gradients that they have; nothing, where these are not finite."""
    state.scale_gradients(1 / config.batch)
    loss = found.mean(LOSS)
    assert loss is not None
    finite = state.gradients_are_finite(loss)
    moves = finite if recorder is None else recorder.counted(finite)
    error, count = found.mean(THERMAL_ERROR), len(state.model.gaussians)
    statistics = StepStatistics(state.step, loss, found.terms, error, count, ~finite)
    # Nothing has changed so far, so that a step for which memory does not suffice can be repeated.
    state.move(config, moves)
    for number, residual in found.residuals.items():
        state.image_model.learn_drift(number, residual, moves)
    return StepResult(statistics, found.observed, finite)


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
