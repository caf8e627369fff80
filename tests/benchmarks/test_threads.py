from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numba
import pytest
import torch

from benchmarks import workload
from mrgs.method.config import make_config
from mrgs.training.step import training_step
from mrgs.training.view_pass import PhotographedView


@contextmanager
def threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads(), numba.get_num_threads()
    try:
        torch.set_num_threads(count)
        numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
        yield
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])


def train(method: str, steps: int = 3) -> dict[str, torch.Tensor]:
    """A few steps in a room that is large enough for every parallel loop to be divided."""
    config = make_config(method, "paper")
    state = workload.training_state(12_000, config)
    view, photos = workload.view(160, 120), workload.photos(160, 120)
    losses = []
    for _ in range(steps):
        statistics = training_step(
            state, [PhotographedView(0, view, photos)], config, workload.SCALE
        ).statistics
        losses.append(statistics.loss)
    tensors = {
        **state.model.gaussians.tensors(),
        **state.model.field.state_dict(),
        "losses": torch.tensor(losses),
    }
    return {name: tensor.detach().clone() for name, tensor in tensors.items()}


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread only")
@pytest.mark.parametrize("method", ["mrgs-plus", "mrgs", "3dgs-rgbt"])
def test_training_gives_the_same_bits_whatever_the_number_of_threads(method):
    with threads(1):
        alone = train(method)
    with threads(2):
        shared = train(method)
    for name, tensor in alone.items():
        assert torch.equal(tensor, shared[name]), name
