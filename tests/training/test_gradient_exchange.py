"""What processes tell each other in a step, and where it lies when it comes back."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import torch

from mrgs.data import load_scene
from mrgs.distributed.sums import ProcessSums, Summand
from mrgs.training import gradient_exchange
from mrgs.training.gradient_exchange import GradientExchange
from mrgs.training.state import initial_state
from mrgs.training.view_sums import LOSS, ViewSums
from tests.helpers.threaded_processes import HOST, together
from tests.helpers.training import short_config


def own_alone(_: Any, by_row: Sequence[Summand], whole: Sequence[Summand]) -> ProcessSums:
    """The sums where no other process has found anything."""
    return ProcessSums([each.value for each in by_row], [each.value for each in whole])


def test_sums_lie_on_the_device_of_the_training(small_scene, monkeypatch):
    monkeypatch.setattr(gradient_exchange, "sum_over_processes", own_alone)
    scene, meta = load_scene(small_scene, resolution=8), torch.device("meta")
    state = initial_state(scene, short_config("3dgs-rgbt"), meta)
    term = state.terms[0].name
    found = ViewSums(
        {LOSS: torch.tensor(3.0), f"term.{term}": torch.tensor(2.0)},
        {LOSS: 1.0, f"term.{term}": 1.0},
        {"gradients": torch.ones(len(state.model.gaussians), device=meta)},
        {4: torch.tensor([0.5, 0.25])},
    )
    exchange = GradientExchange(SimpleNamespace(), 2, slice(0, 1))
    result = exchange(state, found)
    tensors = [*result.totals.values(), *result.observed.values(), *result.residuals.values()]
    assert len(tensors) == 4
    assert all(tensor.device == meta for tensor in tensors)
    assert result.counts == {LOSS: 1.0, f"term.{term}": 1.0}
    assert set(result.residuals) == {4}


def test_all_processes_have_the_sums_of_all_and_stop_together(small_scene):
    scene = load_scene(small_scene, resolution=8)
    shares = [slice(0, 1), slice(1, 3)]

    def step(processes):
        rank = processes.rank
        state = initial_state(scene, short_config("3dgs-rgbt"), HOST)
        gaussians = state.gaussian_optimizer.gaussians.tensors()
        for tensor in gaussians.values():
            tensor.grad = torch.full_like(tensor, float(rank + 1))
        count = len(state.model.gaussians)
        found = ViewSums(
            {LOSS: torch.tensor(10.0 * (rank + 1))},
            {LOSS: float(rank + 1)},
            {"gradients": torch.full((count,), 2.0 + rank)},
            {0: torch.tensor([0.5, 0.25])} if rank == 0 else {
                5: torch.tensor([1.0, 2.0]), 7: torch.tensor([3.0, 4.0])
            },
        )  # fmt: skip
        exchange = GradientExchange(processes, 3, shares[rank])
        stops = [exchange.stops]
        result = exchange(state, found)
        stops.append(exchange.stops)
        gradients = [tensor.grad for tensor in gaussians.values()]
        if rank == 1:
            exchange.ask_to_stop()
        exchange(state, found)
        return result, gradients, [*stops, exchange.stops]

    for result, gradients, stops in together(step, 2):
        assert stops == [False, False, True]
        assert all(bool((each == 3.0).all()) for each in gradients)
        assert (result.totals[LOSS], result.counts[LOSS]) == (30.0, 3.0)
        assert bool((result.observed["gradients"] == 5.0).all())
        residuals = {view: each.tolist() for view, each in result.residuals.items()}
        assert residuals == {0: [0.5, 0.25], 5: [1.0, 2.0], 7: [3.0, 4.0]}
