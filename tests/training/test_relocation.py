from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mrgs.errors import ConfigError
from mrgs.method.density.relocation import (
    RelocationConfig,
    explore,
    relocate,
    shared_opacity,
    shrinkage,
    sparsity_loss,
)
from mrgs.method.optimizer import GaussianOptimizer, OptimizerConfig
from mrgs.rasterizer.reference import rotation_matrices

CONFIG = RelocationConfig(start=0, stop=100, every=10)


def build(
    make_gaussians, opacities_rgb, opacities_thermal=None, shares_opacity=False
) -> GaussianOptimizer:
    gaussians = make_gaussians(len(opacities_rgb), shares_opacity)
    gaussians.opacity_rgb_logit = torch.tensor(opacities_rgb)[:, None].logit()
    if not shares_opacity:
        gaussians.opacity_thermal_logit = torch.tensor(opacities_thermal or opacities_rgb)[
            :, None
        ].logit()
    return GaussianOptimizer(gaussians, OptimizerConfig(), 10.0)


def run(optimizer, budget, step=100, seed=0):
    return relocate(optimizer, CONFIG, step, budget, torch.Generator().manual_seed(seed))


@given(opacity=st.floats(0.01, 0.99), count=st.integers(1, 30))
def test_copies_together_let_through_as_much(opacity, count):
    each = shared_opacity(torch.tensor([opacity], dtype=torch.float64), torch.tensor([count]))
    assert (1 - each.item()) ** count == pytest.approx(1 - opacity, rel=1e-9)


@given(opacity=st.floats(0.05, 0.95), count=st.integers(1, 12))
def test_the_shrinkage_is_that_of_the_double_sum(opacity, count):
    """Eq. 9 as it is printed."""
    each = 1 - (1 - opacity) ** (1 / count)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k * each ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, count + 1)
        for k in range(i)
    )
    found = shrinkage(torch.tensor([opacity], dtype=torch.float64), torch.tensor([count]))
    assert found.item() == pytest.approx(opacity / total, rel=1e-6)


def test_copies_keep_the_integral_of_the_blend():
    """Along a line through the centre: ∫ 1 − Π (1 − o' exp(−x²/2s'²)) is that of one Gaussian."""
    x = torch.linspace(-8, 8, 4001, dtype=torch.float64)
    opacity, count = torch.tensor([0.8], dtype=torch.float64), torch.tensor([5])
    each, shrunk = shared_opacity(opacity, count), shrinkage(opacity, count)
    one = opacity * torch.exp(-0.5 * x**2)
    several = 1 - (1 - each * torch.exp(-0.5 * (x / shrunk) ** 2)) ** 5
    assert several.sum().item() == pytest.approx(one.sum().item(), rel=1e-6)


def test_dead_ones_become_copies_of_live_ones(make_gaussians):
    optimizer = build(make_gaussians, [0.5, 0.001, 0.001])
    before = {
        name: tensor.detach().clone() for name, tensor in optimizer.gaussians.tensors().items()
    }
    counts = run(optimizer, budget=3)
    after = optimizer.gaussians
    assert (counts.moved, counts.added, len(after)) == (2, 0, 3)
    assert torch.equal(after.means, before["means"][:1].expand(3, 3))
    assert after.opacity_rgb.tolist() == pytest.approx([1 - 0.5 ** (1 / 3)] * 3, rel=1e-5)
    assert torch.equal(after.opacity_rgb_logit, after.opacity_thermal_logit)
    factor = shrinkage(torch.tensor([0.5]), torch.tensor([3])).log()
    torch.testing.assert_close(after.log_scales, (before["log_scales"][:1] + factor).expand(3, 3))


def test_what_one_modality_needs_is_not_dead(make_gaussians):
    optimizer = build(make_gaussians, [0.001, 0.5], [0.4, 0.001])
    assert run(optimizer, budget=2).moved == 0


def test_an_opacity_that_is_shared_is_shared_by_the_copies(make_gaussians):
    optimizer = build(make_gaussians, [0.5, 0.001], shares_opacity=True)
    assert run(optimizer, budget=2).moved == 1
    assert optimizer.gaussians.opacity_thermal_logit.shape == (2, 0)


def test_the_budget_is_reached_by_the_last_event_and_never_passed(make_gaussians):
    optimizer = build(make_gaussians, [0.5] * 20)
    sizes = []
    for step in range(10, 101, 10):
        run(optimizer, budget=500, step=step, seed=step)
        sizes.append(len(optimizer.gaussians))
    assert sizes == sorted(sizes)
    assert sizes[-1] == 500
    assert sizes[4] == pytest.approx(math.sqrt(20 * 500), rel=0.05)


def test_a_start_above_the_budget_is_kept(make_gaussians):
    optimizer = build(make_gaussians, [0.5] * 20)
    assert run(optimizer, budget=10).added == 0
    assert len(optimizer.gaussians) == 20


def test_without_a_live_one_nothing_is_done(make_gaussians):
    optimizer = build(make_gaussians, [0.001, 0.001])
    assert run(optimizer, budget=10) == (0, 0)


def test_noise_has_the_shape_of_the_gaussian_and_spares_the_opaque(make_gaussians):
    count = 20_000
    optimizer = build(make_gaussians, [0.005] * count)
    one = {name: tensor.detach()[:1] for name, tensor in optimizer.gaussians.tensors().items()}
    gaussians = type(optimizer.gaussians)(
        **{name: tensor.repeat_interleave(count, 0) for name, tensor in one.items()}
    )
    explore(gaussians, 1e-5, CONFIG, torch.Generator().manual_seed(0))
    moved = gaussians.means - one["means"]
    rotation = rotation_matrices(one["quats"])[0]
    along = moved @ rotation
    variances = one["log_scales"].exp().square()[0]
    expected = 0.5 * CONFIG.noise * 1e-5 * variances
    assert along.std(dim=0).tolist() == pytest.approx(expected.tolist(), rel=0.03)
    gaussians.opacity_rgb_logit = torch.full((count, 1), 2.0)
    before = gaussians.means.clone()
    explore(gaussians, 1e-5, CONFIG, torch.Generator().manual_seed(0))
    torch.testing.assert_close(gaussians.means, before)


def test_what_is_not_needed_costs(make_gaussians):
    gaussians = build(make_gaussians, [0.2, 0.4], [0.6, 0.8]).gaussians
    config = RelocationConfig(opacity_weight=2.0, scale_weight=3.0)
    expected = 2.0 * 0.5 * (0.3 + 0.7) + 3.0 * gaussians.scales.mean().item() / 5.0
    assert sparsity_loss(gaussians, 5.0, config).item() == pytest.approx(expected)


def test_a_schedule_that_ends_before_it_starts_is_refused():
    with pytest.raises(ConfigError, match="start must come before stop"):
        RelocationConfig(start=10, stop=10)
