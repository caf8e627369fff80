"""One training step: the paper's algorithm from the photos of a view to the moved parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.method.config import TrainConfig
from mrgs.method.density import DensityStep
from mrgs.method.losses.term import SceneScale
from mrgs.run_files.record import StepStatistics
from mrgs.training.recorder import Recorder
from mrgs.training.state import TrainingState
from mrgs.training.view_pass import (
    PhotographedView,
    ViewInputs,
    ViewMeasures,
    forward_backward,
    view_inputs,
)


class StepResult(NamedTuple):
    """A step that has moved the parameters, before density control: what the strategy observed,
    summed over the views, and whether loss and gradients were finite, on the device."""

    statistics: StepStatistics
    observed: Mapping[str, Float[Tensor, " n"]]
    finite: Bool[Tensor, ""]


def means(
    measures: Sequence[ViewMeasures],
) -> tuple[Float[Tensor, ""], dict[str, Float[Tensor, ""]], Float[Tensor, ""] | None]:
    """L_total, the unweighted terms by name, and the thermal error of a step: each a mean over the
    views that have it."""
    names = dict.fromkeys(name for each in measures for name in each.terms)
    terms = {
        name: _mean([each.terms[name] for each in measures if name in each.terms]) for name in names
    }
    errors = [each.thermal_error for each in measures if each.thermal_error is not None]
    loss = _mean([each.loss for each in measures])
    return loss, terms, _mean(errors, torch.nanmean) if errors else None  # NaN: no valid pixel


def _mean(
    values: Sequence[Float[Tensor, ""]], mean: Callable[[Tensor], Tensor] = torch.mean
) -> Float[Tensor, ""]:
    return values[0] if len(values) == 1 else mean(torch.stack(list(values)))


def training_step(
    state: TrainingState,
    views: Sequence[PhotographedView],
    config: TrainConfig,
    scale: SceneScale,
    recorder: Recorder | None = None,
) -> StepResult:
    """Render as many views as the configuration's ``batch``, compare them with their photos, move
    the parameters once; nothing where loss or gradients are not finite, which a GPU decides without
    waiting on the host. ``recorder`` replays the pass of a step's only view on a GPU."""
    state.step += 1
    state.model.sh_degree = config.sh_degree_at(state.step)
    state.refresh_neighbours(config)
    if len(views) > 1:
        recorder = None

    def run(inputs: ViewInputs) -> ViewMeasures:
        return forward_backward(state, inputs, scale)

    while True:
        found: list[tuple[int, ViewMeasures]] = []
        observed: dict[str, Tensor] = {}
        for each in views:
            inputs = view_inputs(state, each, config)
            measures = run(inputs) if recorder is None else recorder.run(state, inputs, run)
            found.append((each.number, measures))
            for name, value in state.strategy.observe(measures.passes).items():
                observed[name] = observed[name] + value if name in observed else value
        result = _move(state, found, observed, config, recorder)
        if recorder is None or recorder.had_room():
            break
    state.skipped_in_a_row = (state.skipped_in_a_row + 1) * ~result.finite
    return result


def _move(
    state: TrainingState,
    found: Sequence[tuple[int, ViewMeasures]],
    observed: Mapping[str, Float[Tensor, " n"]],
    config: TrainConfig,
    recorder: Recorder | None,
) -> StepResult:
    """Move the parameters by their gradients; if these are not finite, nothing moves."""
    state.scale_gradients(1 / config.batch)
    loss, terms, error = means([measures for _, measures in found])
    finite = state.gradients_are_finite(loss)
    moves = finite if recorder is None else recorder.counted(finite)
    count = len(state.model.gaussians)
    statistics = StepStatistics(state.step, loss, terms, error, count, ~finite)
    # Nothing has changed so far, so that a step can be repeated if the memory is full.
    state.move(config, moves)
    for number, measures in found:
        if measures.residual is not None:
            state.image_model.learn(number, measures.residual, moves)
    return StepResult(statistics, observed, finite)


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
