from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn.functional import conv1d

from mrgs.field.heat import FourierHeatTransformation, nearest_neighbours
from mrgs.kernels.heat.residuals import _exchange_in_torch, readout_constants, readout_rows


def random_case(count: int = 12, width: int = 4, k: int = 3, extra: int = 0, seed: int = 0):
    """A float64 transformation and its inputs; ``extra`` rows are read only as neighbours."""
    torch.manual_seed(seed)
    heat = FourierHeatTransformation(width, k, 0.9, 0.1).double()
    features = torch.randn(count + extra, width, dtype=torch.float64, requires_grad=True)
    opacity = torch.rand(count, dtype=torch.float64).requires_grad_()
    neighbours = torch.randint(0, count + extra, (count, k))
    return heat, features, opacity, neighbours


def read_out(heat, features, opacity, neighbours, output):
    """``output`` behind ``heat`` by the numbers of ``readout``, for the first rows."""
    projected = features @ readout_rows(heat, output, torch.matmul).T
    anchors = projected[: len(neighbours)]
    if heat.k == 0:
        return anchors + output.bias
    constants = readout_constants(heat, output, torch.matmul)
    weights = (heat.anchor_weight, heat.surrounding_weight)
    return _exchange_in_torch(projected, opacity, constants, neighbours, anchors, weights)[:, None]


def refine_one_by_one(heat, features, opacity, neighbours):
    """Eq. 11 and 12, one Gaussian at a time."""
    refined = []
    for i, row in enumerate(neighbours):
        surroundings = features[row]
        difference = (surroundings - features[i]).T[None]
        gradient = conv1d(difference, heat.f_grad.weight, heat.f_grad.bias)
        flux = conv1d(-opacity[i] * gradient, heat.f_q.weight, heat.f_q.bias)[0, :, 0]
        refined.append(0.9 * (features[i] + flux) + 0.1 * surroundings.mean(dim=0))
    return torch.stack(refined)


@pytest.mark.parametrize("extra", [0, 5])
def test_forward_is_the_equations(extra):
    case = random_case(extra=extra)
    torch.testing.assert_close(case[0](*case[1:]), refine_one_by_one(*case))


@pytest.mark.parametrize("extra", [0, 5])
@pytest.mark.parametrize("k", [0, 1, 8])
def test_readout_is_the_output_layer_behind_forward(k, extra):
    heat, features, opacity, neighbours = random_case(k=k, extra=extra)
    output = nn.Linear(4, 1).double()
    tensors = [features, opacity, *heat.parameters(), *output.parameters()]

    def value_and_gradients(result):
        weights = torch.linspace(-1, 2, result.numel(), dtype=torch.float64)
        return [
            result,
            *torch.autograd.grad((result[:, 0] * weights).sum(), tensors, materialize_grads=True),
        ]

    fast = value_and_gradients(read_out(heat, features, opacity, neighbours, output))
    literal = value_and_gradients(output(heat(features, opacity, neighbours)))
    torch.testing.assert_close(fast, literal)


def test_gradients():
    heat, features, opacity, neighbours = random_case(count=5)
    output = nn.Linear(4, 1).double()
    assert torch.autograd.gradcheck(lambda f, o: heat(f, o, neighbours), (features, opacity))
    assert torch.autograd.gradcheck(
        lambda f, o: read_out(heat, f, o, neighbours, output), (features, opacity)
    )


def test_readout_repeats_bit_for_bit():
    heat, features, opacity, neighbours = random_case(count=4000, width=8, k=8)
    heat, output = heat.float(), nn.Linear(8, 1)
    features = features.detach().float().requires_grad_()

    def gradient():
        result = read_out(heat, features, opacity.detach().float(), neighbours, output)
        return torch.autograd.grad(result.square().sum(), features)[0]

    assert torch.equal(gradient(), gradient())


def test_without_neighbours_features_stay():
    heat, features, opacity, neighbours = random_case(k=0)
    assert torch.equal(heat(features, opacity, neighbours), features)


def test_gradient_reaches_the_neighbours():
    heat, features, opacity, _ = random_case(count=3, k=1)
    neighbours = torch.tensor([[1], [1], [1]])
    (gradient,) = torch.autograd.grad(heat(features, opacity, neighbours)[0].sum(), features)
    assert gradient[1].abs().sum() > 0
    assert gradient[2].abs().sum() == 0


def test_renumbering_the_gaussians_renumbers_the_result():
    heat, features, opacity, neighbours = random_case()
    order = torch.randperm(12)
    place = torch.argsort(order)
    renumbered = heat(features[order], opacity[order], place[neighbours[order]])
    torch.testing.assert_close(renumbered, heat(features, opacity, neighbours)[order])


@settings(deadline=None)
@given(
    count=st.integers(0, 30),
    k=st.integers(0, 9),
    seed=st.integers(0, 2**31),
    coincident=st.booleans(),
)
def test_neighbours_are_those_of_a_full_search(count, k, seed, coincident):
    generator = torch.Generator().manual_seed(seed)
    if coincident:  # a 2 × 2 × 2 lattice: many points fall together
        means = torch.randint(0, 2, (count, 3), generator=generator).float()
    else:
        means = torch.randn(count, 3, generator=generator)
    neighbours = nearest_neighbours(means, k)
    assert neighbours.shape == (count, k)
    assert neighbours.dtype == torch.int64

    found = max(min(k, count - 1), 0)
    distances = torch.cdist(
        means.double(), means.double(), compute_mode="donot_use_mm_for_euclid_dist"
    )
    distances.fill_diagonal_(torch.inf)
    expected = distances.sort(dim=1).values[:, :found]
    torch.testing.assert_close(distances.gather(1, neighbours[:, :found]), expected)
    itself = torch.arange(count)[:, None]
    assert (neighbours[:, :found] != itself).all()
    assert (neighbours[:, found:] == itself).all()
    assert all(len(set(row)) == found for row in neighbours[:, :found].tolist())


def test_positions_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="finite"):
        nearest_neighbours(torch.tensor([[0.0, 0.0, 0.0], [1.0, float("nan"), 0.0]]), 1)
