from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mrgs_thermonerf.model import composite, median_distance, render_weights


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_weights_are_those_of_the_loop():
    densities, lengths = 5 * random(3, 8), random(3, 8, seed=1)
    weights = render_weights(densities, lengths)
    for ray in range(3):
        transmittance = 1.0
        for i in range(8):
            alpha = 1 - math.exp(-densities[ray, i] * lengths[ray, i])
            assert weights[ray, i].item() == pytest.approx(transmittance * alpha)
            transmittance *= 1 - alpha


@given(st.lists(st.floats(0, 1e5), min_size=1, max_size=20))
def test_weights_are_shares_of_one(densities):
    weights = render_weights(torch.tensor([densities]), torch.full((1, len(densities)), 0.3))
    assert (weights >= 0).all()
    assert weights.sum() <= 1 + 1e-5


def test_gradients_of_volume_rendering_are_those_of_finite_differences():
    densities, values = (
        (4 * random(2, 6)).requires_grad_(),
        random(2, 6, 3, seed=1).requires_grad_(),
    )
    lengths = random(2, 6, seed=2)
    assert torch.autograd.gradcheck(
        lambda d, v: composite(render_weights(d, lengths), v), (densities, values)
    )


def test_a_uniform_medium_absorbs_exponentially():
    weights = render_weights(torch.full((1, 50), 2.0), torch.full((1, 50), 0.01))
    assert weights.sum().item() == pytest.approx(1 - math.exp(-1), rel=1e-5)


def test_the_median_distance_has_half_of_the_weight_before_it():
    distances = torch.tensor([[1.0, 2, 4, 5, 1000]])
    torch.testing.assert_close(
        median_distance(torch.tensor([[0.2, 0.5, 0.1, 0.0]]), distances), torch.tensor([2.8])
    )
    torch.testing.assert_close(
        median_distance(torch.tensor([[0.0, 0.0, 1.0, 0.0]]), distances), torch.tensor([4.5])
    )
    assert median_distance(torch.zeros(1, 4), distances).isfinite().all()
