from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mrgs_thermonerf.run import (
    distortion_loss,
    interlevel_loss,
    squared_error,
)


def random_edges(rays: int, count: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    inner = torch.rand(rays, count - 1, generator=generator, dtype=torch.float64).sort(dim=1).values
    return torch.cat([torch.zeros(rays, 1), inner, torch.ones(rays, 1)], dim=1).double()


def random_weights(rays: int, count: int, seed: int) -> torch.Tensor:
    values = (
        torch.rand(rays, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        + 0.01
    )
    return values / values.sum(dim=1, keepdim=True)


@given(st.integers(0, 200))
def test_interlevel_loss_is_that_of_the_loop(seed):
    edges, weights = random_edges(2, 6, seed), random_weights(2, 6, seed + 1)
    proposal_edges, proposal_weights = random_edges(2, 9, seed + 2), random_weights(2, 9, seed + 3)
    expected = 0.0
    for ray in range(2):
        for i in range(6):
            bound = sum(
                proposal_weights[ray, j].item()
                for j in range(9)
                if proposal_edges[ray, j] < edges[ray, i + 1]
                and proposal_edges[ray, j + 1] > edges[ray, i]
            )
            weight = weights[ray, i].item()
            expected += max(0.0, weight - bound) ** 2 / (weight + 1e-7) / 2
    found = interlevel_loss(edges, weights, proposal_edges, proposal_weights)
    assert found.item() == pytest.approx(expected, abs=1e-9)


def test_a_proposal_that_covers_the_field_costs_nothing():
    edges, weights = random_edges(3, 8, 0), random_weights(3, 8, 1)
    assert interlevel_loss(edges, weights, edges, weights) < 1e-30


def test_interlevel_gradients_reach_the_proposals_alone():
    edges, weights = random_edges(2, 6, 0), random_weights(2, 6, 1).requires_grad_()
    proposal_edges, proposal_weights = (
        random_edges(2, 9, 2),
        (0.3 * random_weights(2, 9, 3)).requires_grad_(),
    )
    interlevel_loss(edges, weights, proposal_edges, proposal_weights).backward()
    assert weights.grad is None
    assert proposal_weights.grad.abs().max() > 0
    assert torch.autograd.gradcheck(
        lambda proposals: interlevel_loss(edges, weights, proposal_edges, proposals),
        proposal_weights,
    )


@given(st.integers(0, 200))
def test_distortion_is_the_double_sum(seed):
    edges, weights = random_edges(1, 7, seed), random_weights(1, 7, seed + 1)
    middles = 0.5 * (edges[0, 1:] + edges[0, :-1])
    double_sum = (weights[0, :, None] * weights[0] * (middles[:, None] - middles).abs()).sum()
    expected = double_sum + (weights[0].square() * edges[0].diff()).sum() / 3
    assert distortion_loss(edges, weights).item() == pytest.approx(expected.item())


def test_distortion_gradients_are_those_of_finite_differences():
    weights = random_weights(2, 7, 1).requires_grad_()
    assert torch.autograd.gradcheck(lambda w: distortion_loss(random_edges(2, 7, 0), w), weights)


def test_invalid_rays_do_not_count():
    rendered, target = torch.zeros(3, 2), torch.tensor([[1.0, 1], [2, 2], [torch.nan, 3]])
    assert squared_error(rendered, target, torch.tensor([True, True, False])) == 2.5
    assert squared_error(rendered, target, torch.zeros(3, dtype=torch.bool)) == 0
    assert squared_error(rendered[:2], target[:2], None) == 2.5
