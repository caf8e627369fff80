"""One training step: the paper's algorithm from the photos of a view to the moved parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.method.config import TrainConfig
from mrgs.method.density import DensityStep
from mrgs.method.losses.term import SceneScale
from mrgs.training.recorder import Recorder
from mrgs.training.state import TrainingState
from mrgs.training.view_pass import (
    PhotographedView,
    ViewInputs,
    ViewMeasures,
    forward_backward,
    view_inputs,
)


class StepStatistics:
    """The measurements of a step. On a GPU the numbers are fetched when the first of them is
    read, which waits for the GPU.

    Attributes:
        step: number of the step, from 1.
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
        self._measured = _as_one([loss, skipped, error, *terms.values()])

    @property
    def loss(self) -> float:
        """L_total; not finite if the step was skipped for it."""
        return self._read()[0]

    @property
    def skipped(self) -> bool:
        """Whether the loss or a gradient was not finite, so that nothing was changed."""
        return bool(self._read()[1])

    @property
    def thermal_error(self) -> float | None:
        """Mean absolute error of the normalised temperature on the training view; None without a
        thermal photo."""
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


def _as_one(numbers: Sequence[float | Tensor]) -> Tensor | list[float]:
    """Numbers as one tensor, to be fetched at once, if any of them is a tensor."""
    like = next((number.detach() for number in numbers if isinstance(number, Tensor)), None)
    if like is None:
        return [float(number) for number in numbers]
    return torch.stack(
        [
            n.detach().to(like) if isinstance(n, Tensor) else torch.full_like(like, n)
            for n in numbers
        ]
    )


class StepResult(NamedTuple):
    """A step that has moved the parameters, before density control.

    Attributes:
        statistics: the measurements.
        observed: the strategy's observations, summed over the views.
        finite: whether loss and gradients were finite; on the device.
    """

    statistics: StepStatistics
    observed: Mapping[str, Float[Tensor, " n"]]
    finite: Bool[Tensor, ""]


LOSS, THERMAL_ERROR, TERM = "loss", "thermal_error", "term."


@dataclass
class ViewSums:
    """Sums of measurements over the views of a step; not every view has every number.

    Attributes:
        totals: sums by name: ``loss``, ``thermal_error``, and ``term.NAME`` of each unweighted
            term.
        counts: number of views in each sum.
        observed: the strategy's observations, [N] each.
        residuals: of each view's thermal photo, by its number, if drift is modelled.
    """

    totals: dict[str, Tensor] = field(default_factory=dict)
    counts: dict[str, Tensor | float] = field(default_factory=dict)
    observed: dict[str, Tensor] = field(default_factory=dict)
    residuals: dict[int, Float[Tensor, "2"]] = field(default_factory=dict)

    def add(
        self, number: int, measures: ViewMeasures, observed: Mapping[str, Float[Tensor, " n"]]
    ) -> None:
        """Add the measurements of the view of this number, and the strategy's observations."""
        self._add(LOSS, measures.loss, 1.0)
        for name, value in measures.terms.items():
            self._add(f"{TERM}{name}", value, 1.0)
        if (error := measures.thermal_error) is not None:
            is_known = ~error.isnan()  # no pixel is valid
            self._add(THERMAL_ERROR, torch.where(is_known, error, 0), is_known.float())
        for name, value in observed.items():
            self.observed[name] = self.observed[name] + value if name in self.observed else value
        if measures.residual is not None:
            self.residuals[number] = measures.residual

    def _add(self, name: str, value: Tensor, count: Tensor | float) -> None:
        has_some = name in self.totals
        self.totals[name] = self.totals[name] + value if has_some else value
        self.counts[name] = self.counts[name] + count if has_some else count

    def mean(self, name: str) -> Float[Tensor, ""] | None:
        """Mean over the views that have a number; None if no view has it."""
        return self.totals[name] / self.counts[name] if name in self.totals else None

    @property
    def terms(self) -> dict[str, Float[Tensor, ""]]:
        """Means of the unweighted terms, by name."""
        names = [name for name in self.totals if name.startswith(TERM)]
        return {name.removeprefix(TERM): self.totals[name] / self.counts[name] for name in names}


def training_step(
    state: TrainingState,
    views: Sequence[PhotographedView],
    config: TrainConfig,
    scale: SceneScale,
    recorder: Recorder | None = None,
) -> StepResult:
    """Render views, compare them with their photos, move the parameters once.

    A step whose loss or gradients are not finite moves nothing. On a GPU that is decided there,
    without waiting on the host.

    Args:
        state: changed in place.
        views: as many as the ``batch`` of the configuration.
        config: of the run.
        scale: of the scene.
        recorder: replays the pass of a step's only view on a GPU.
    """
    state.step += 1
    state.model.sh_degree = config.sh_degree_at(state.step)
    state.refresh_neighbours(config)
    if len(views) > 1:
        recorder = None

    def run(inputs: ViewInputs) -> ViewMeasures:
        return forward_backward(state, inputs, scale)

    while True:
        found = ViewSums()
        for each in views:
            inputs = view_inputs(state, each, config)
            measures = run(inputs) if recorder is None else recorder.run(state, inputs, run)
            found.add(each.number, measures, state.strategy.observe(measures.passes))
        result = _move(state, found, config, recorder)
        if recorder is None or recorder.had_room():
            break
    state.skipped_in_a_row = (state.skipped_in_a_row + 1) * ~result.finite
    return result


def _move(
    state: TrainingState, found: ViewSums, config: TrainConfig, recorder: Recorder | None
) -> StepResult:
    """Move the parameters by their gradients; if these are not finite, nothing moves."""
    state.scale_gradients(1 / config.batch)
    loss = found.mean(LOSS)
    assert loss is not None
    finite = state.gradients_are_finite(loss)
    moves = finite if recorder is None else recorder.counted(finite)
    error, count = found.mean(THERMAL_ERROR), len(state.model.gaussians)
    statistics = StepStatistics(state.step, loss, found.terms, error, count, ~finite)
    # Nothing has changed so far, so that a step can be repeated if the memory is full.
    state.move(config, moves)
    if (drift := state.image_model.thermal_drift) is not None:
        for number, residual in found.residuals.items():
            drift.learn(number, residual, moves)
    return StepResult(statistics, found.observed, finite)


def control_density(
    state: TrainingState, result: StepResult, config: TrainConfig, extent: float
) -> Mapping[str, int] | None:
    """Let the strategy adapt the Gaussians after a step, in place; its counts for the log, None if
    it left the rows as they are. If a GPU's memory is full, nothing has changed."""
    strategy, before = state.strategy, state.model.gaussians.means
    views = result.observed.items()
    observed = {name: torch.where(result.finite, value, 0) for name, value in views}
    step = DensityStep(
        state.step, extent, config.distant_points, observed, result.finite, state.generator
    )
    update = strategy.after_step(state.strategy_state, state.gaussian_optimizer, step)
    state.strategy_state = update.state
    if state.model.gaussians.means is not before:
        state.model.neighbours = None
    return update.counts
