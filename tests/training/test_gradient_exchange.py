"""What comes back from other processes lies where the training computes."""

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
