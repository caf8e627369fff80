"""Whole steps, rendering, Adam, and a densification event, as the trainer calls them."""

from __future__ import annotations

from dataclasses import replace

import torch

from benchmarks.plan import Case
from benchmarks.timing import Stages, Timing
from benchmarks.workload import CAPTURE, EXTENT, SCALE, photos, training_state, view
from mrgs.field import nearest_neighbours
from mrgs.method.config import Preset, TrainConfig, make_config
from mrgs.render import bake_temperature_residuals, render
from mrgs.scene import Gaussians
from mrgs.training.state import TrainingState
from mrgs.training.step import (
    StepResult,
    StepStatistics,
    control_density,
    training_step,
)
from mrgs.training.view_pass import PhotographedView

STEP = "step"
RENDER = "render"
EVENT = "rows moved and neighbours searched"

DENSIFIED_SHARE = 0.1
"""Share of the Gaussians that the event chooses: half are cloned, half split."""


def mrgs_step(case: Case) -> Stages:
    """Both heads, heat transformation, all losses, Adam."""
    return _step(case, "mrgs", "default")


def paper_step(case: Case) -> Stages:
    """The same with heads as wide as in the paper preset."""
    return _step(case, "mrgs", "paper")


def baseline_step(case: Case) -> Stages:
    """Spherical harmonics, one opacity, the photometric losses, Adam."""
    return _step(case, "3dgs-rgbt", "default")


def _step(case: Case, method: str, preset: Preset) -> Stages:
    count, width, height = case.size
    config = make_config(method, preset)
    state = training_state(count, config)
    views = [PhotographedView(0, view(width, height), photos(width, height))]
    return Stages([Timing(STEP, lambda _: training_step(state, views, config, SCALE))])


def rendering(case: Case) -> Stages:
    """The images of a view of a trained MrGS model, whose t̂ is computed once for all views, without
    the median depths that an evaluation renders besides."""
    count, width, height = case.size
    model = bake_temperature_residuals(training_state(count, make_config("mrgs", "default")).model)
    cameras = view(width, height).cameras
    return Stages([Timing(RENDER, torch.no_grad()(lambda _: render(model, cameras)))])


def adam(case: Case) -> Stages:
    """One step over all parameters of the Gaussians of MrGS."""
    assert case.gaussians is not None
    optimizer = training_state(case.gaussians, make_config("mrgs", "paper")).gaussian_optimizer
    tensors = optimizer.gaussians.tensors().values()
    gradients = [1e-3 * torch.ones_like(tensor) for tensor in tensors]

    def with_gradients() -> None:
        for tensor, gradient in zip(tensors, gradients, strict=True):
            tensor.grad = gradient

    return Stages([Timing("Adam", lambda _: optimizer.step(0.5), with_gradients)])


def densification(case: Case) -> Stages:
    """Clone, split and prune with their Adam moments, then the neighbours of the new Gaussians."""
    assert case.gaussians is not None
    config = make_config("mrgs", "paper")
    start = training_state(case.gaussians, config)
    config = _choosing(start.model.gaussians, config)

    def event(state: TrainingState) -> None:
        statistics = StepStatistics(state.step, 0.0, {}, None, len(state.model.gaussians), False)
        nothing = {name: torch.zeros_like(each) for name, each in state.strategy_state.items()}
        done = StepResult(statistics, nothing, torch.tensor(True))
        control_density(state, done, config, EXTENT)
        state.model.neighbours = nearest_neighbours(
            state.model.gaussians.means, config.field.neighbours_k
        )

    return Stages([Timing(EVENT, event, lambda: _before_event(start, config))])


def _choosing(gaussians: Gaussians, config: TrainConfig) -> TrainConfig:
    """Thresholds by which a tenth of the Gaussians densifies, whatever their number."""
    median_size = gaussians.scales.detach().max(dim=1).values.median().item()
    thresholds = replace(
        config.densification,
        gradient_threshold=1 - DENSIFIED_SHARE,
        clone_below=median_size / EXTENT,
    )
    return replace(config, densification=thresholds)


def _before_event(start: TrainingState, config: TrainConfig) -> TrainingState:
    """A copy of the state at a step that densifies, with Adam's moments and screen-space
    gradients."""
    copies = Gaussians.from_tensors(
        {name: t.detach().clone() for name, t in start.model.gaussians.tensors().items()}
    )
    model = replace(start.model, gaussians=copies)
    generator = torch.Generator().manual_seed(5)
    state = TrainingState.around(model, (), config.densification, config, CAPTURE, generator)
    for tensor in state.gaussian_optimizer.gaussians.tensors().values():
        tensor.grad = torch.zeros_like(tensor)
    state.gaussian_optimizer.step(0.5)
    count = len(model.gaussians)
    seen = {"gradient_sum": torch.rand(count, generator=generator), "views": torch.ones(count)}
    step = config.densification.start + config.densification.every
    return replace(state, step=step, strategy_state=seen)
