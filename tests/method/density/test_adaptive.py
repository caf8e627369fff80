from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from mrgs.errors import ConfigError
from mrgs.method.density.adaptive import (
    AdaptiveDensityControl,
    densify,
    mean_gradients,
)
from mrgs.method.density.strategy import DensityStep
from mrgs.method.optimizer import GaussianOptimizer, OptimizerConfig
from mrgs.rasterizer.reference import rotation_matrices
from mrgs.render import ScreenPoints
from mrgs.scene import RGB, THERMAL, Gaussians
from tests.helpers.gaussians import random_gaussians

EXTENT = 10.0
CONFIG = AdaptiveDensityControl(
    gradient_threshold=1.0, clone_below=0.01, prune_above=0.5, max_gaussians=1_000
)
SMALL, LARGE, HUGE = 0.05, 0.5, 6.0
"""Sizes below and above ``clone_below``, and above ``prune_above``, at this extent."""


def logit(opacity: float) -> float:
    return math.log(opacity / (1 - opacity))


def build(
    sizes, opacities_rgb=None, opacities_thermal=None, shares_opacity=False
) -> GaussianOptimizer:
    gaussians = random_gaussians(len(sizes), shares_opacity)
    gaussians.log_scales = torch.tensor(sizes).log()[:, None] + torch.tensor([0.0, -0.5, -2.0])
    gaussians.opacity_logits[RGB] = torch.tensor(
        [logit(o) for o in opacities_rgb or [0.5] * len(sizes)]
    )[:, None]
    if not shares_opacity:
        thermal = torch.tensor([logit(o) for o in opacities_thermal or [0.5] * len(sizes)])
        gaussians.opacity_logits[THERMAL] = thermal[:, None]
    return GaussianOptimizer(gaussians, OptimizerConfig(), EXTENT)


def run(
    optimizer, gradients, config=CONFIG, prunes_large=False, seed=0
) -> tuple[dict[str, int], Gaussians]:
    generator = torch.Generator().manual_seed(seed)
    change = densify(
        optimizer.gaussians, torch.tensor(gradients), config, EXTENT, prunes_large, generator
    )
    optimizer.replace_rows(change.keep, change.added)
    return change.counts, optimizer.gaussians


def test_a_small_one_with_a_large_gradient_is_cloned():
    optimizer = build([SMALL, SMALL, SMALL])
    before = {
        name: tensor.detach().clone() for name, tensor in optimizer.gaussians.tensors().items()
    }
    counts, after = run(optimizer, [0.5, 1.5, 0.99])
    assert counts == {"cloned": 1, "split": 0, "pruned": 0}
    for name, tensor in after.tensors().items():
        assert torch.equal(tensor, torch.cat([before[name], before[name][1:2]])), name


def test_a_large_one_with_a_large_gradient_is_split_into_two_smaller_ones_within_it():
    optimizer = build([SMALL, LARGE, LARGE])
    before = {
        name: tensor.detach().clone() for name, tensor in optimizer.gaussians.tensors().items()
    }
    counts, after = run(optimizer, [0.5, 1.5, 0.5])
    assert counts == {"cloned": 0, "split": 1, "pruned": 0}
    assert len(after) == 4
    torch.testing.assert_close(
        after.log_scales[2:].exp(), (before["log_scales"][[1, 1]].exp() / 1.6)
    )
    rotation = rotation_matrices(before["quats"][1:2])[0]
    in_sigmas = (after.means[2:] - before["means"][1]) @ rotation / before["log_scales"][1].exp()
    assert (in_sigmas.norm(dim=1) < 4).all()
    assert not torch.equal(after.means[2], after.means[3])
    for name, tensor in after.tensors().items():
        assert torch.equal(tensor[:2], before[name][[0, 2]]), name
        if name not in ("means", "log_scales"):
            assert torch.equal(tensor[2:], before[name][[1, 1]]), name


def test_halves_are_drawn_from_the_rotated_gaussian():
    count = 20_000
    optimizer = build([LARGE])
    one = optimizer.gaussians
    optimizer = GaussianOptimizer(
        Gaussians.from_tensors(
            {
                name: tensor.detach().repeat_interleave(count, 0)
                for name, tensor in one.tensors().items()
            }
        ),
        OptimizerConfig(),
        EXTENT,
    )
    _, after = run(optimizer, [2.0] * count, replace(CONFIG, max_gaussians=10 * count))
    assert len(after) == 2 * count
    rotation = rotation_matrices(one.quats.detach())[0]
    expected = rotation @ torch.diag(one.scales[0].square()) @ rotation.T
    places = (after.means - one.means).detach()
    torch.testing.assert_close(torch.cov(places.T), expected.detach(), rtol=0, atol=0.03 * LARGE**2)
    assert places.mean(dim=0).norm() < 0.03 * LARGE


def test_split_along_the_longest_axis_the_halves_lie_beside_each_other():
    optimizer = build([SMALL, LARGE, LARGE], [0.5, 0.8, 0.5], [0.5, 0.4, 0.5])
    before = {
        name: tensor.detach().clone() for name, tensor in optimizer.gaussians.tensors().items()
    }
    counts, after = run(optimizer, [1.5, 1.5, 0.5], replace(CONFIG, split_longest=True))
    assert counts == {"cloned": 0, "split": 2, "pruned": 0}
    assert torch.equal(after.means[0], before["means"][2])
    scales = before["log_scales"][1].exp()
    shares = torch.tensor([0.5, 0.85, 0.85])  # the first axis is the longest
    torch.testing.assert_close(after.log_scales[3:].exp(), (scales * shares).expand(2, 3))
    axis = rotation_matrices(before["quats"][1:2])[0, :, 0]
    offsets = after.means[3:] - before["means"][1]
    torch.testing.assert_close(offsets[0], -offsets[1])
    torch.testing.assert_close(offsets[0], scales[0] * math.sqrt(0.75) * axis)
    assert after.opacity(RGB)[3:].tolist() == pytest.approx([0.48, 0.48])
    assert after.opacity(THERMAL)[3:].tolist() == pytest.approx([0.24, 0.24])


def test_halves_are_together_as_long_as_their_parent():
    _, after = run(build([LARGE]), [1.5], replace(CONFIG, split_longest=True))
    own = after.log_scales[0, 0].exp() ** 2
    apart = (after.means[0] - after.means[1]).norm() / 2
    assert (own + apart**2).item() == pytest.approx(LARGE**2, rel=1e-5)


def test_none_is_split_where_no_gradient_is_large():
    counts, after = run(build([SMALL, LARGE]), [0.5, 0.5], replace(CONFIG, split_longest=True))
    assert counts == {"cloned": 0, "split": 0, "pruned": 0}
    assert len(after) == 2


@pytest.mark.parametrize(("prune_unshared", "left"), [(False, [1, 2, 3]), (True, [3])])
def test_transparent_in_both_modalities_is_pruned_or_in_any(prune_unshared, left):
    transparent, opaque = 0.004, 0.006
    optimizer = build(
        [SMALL] * 4,
        opacities_rgb=[transparent, transparent, opaque, opaque],
        opacities_thermal=[transparent, opaque, transparent, opaque],
    )
    before = optimizer.gaussians.means.detach().clone()
    counts, after = run(optimizer, [0.0] * 4, replace(CONFIG, prune_unshared=prune_unshared))
    assert counts == {"cloned": 0, "split": 0, "pruned": 4 - len(left)}
    assert torch.equal(after.means, before[left])


def test_a_shared_opacity_decides_alone():
    optimizer = build(
        [SMALL, LARGE, SMALL],
        opacities_rgb=[0.004, 0.5, 0.006],
        shares_opacity=True,
    )
    before = optimizer.gaussians.means.detach().clone()
    counts, after = run(optimizer, [0.0, 2.0, 0.0])
    assert counts == {"cloned": 0, "split": 1, "pruned": 1}
    assert torch.equal(after.means[0], before[2])
    assert set(after.opacity_logits) == {RGB}


@pytest.mark.parametrize(("prunes_large", "left"), [(False, 3), (True, 2)])
def test_huge_ones_are_pruned_once_that_is_asked_for(prunes_large, left):
    optimizer = build([SMALL, HUGE, LARGE])
    counts, after = run(optimizer, [0.0] * 3, prunes_large=prunes_large)
    assert (counts["pruned"], len(after)) == (3 - left, left)


def test_transparent_clones_and_halves_do_not_stay():
    optimizer = build([SMALL, LARGE, SMALL], [0.001, 0.001, 0.5], [0.001, 0.001, 0.5])
    _, after = run(optimizer, [2.0, 2.0, 0.0])
    assert len(after) == 1


def test_the_cap_lets_the_largest_gradients_go_first():
    optimizer = build([SMALL] * 5)
    before = optimizer.gaussians.means.detach().clone()
    counts, after = run(optimizer, [1.1, 3.0, 1.2, 2.0, 0.1], replace(CONFIG, max_gaussians=7))
    assert counts["cloned"] == 2
    assert torch.equal(after.means[5:], before[[1, 3]])


@pytest.mark.parametrize("cap", [1, 3, 4, 6])
def test_the_cap_is_never_exceeded(cap):
    optimizer = build([SMALL, LARGE, LARGE])
    _, after = run(optimizer, [5.0] * 3, replace(CONFIG, max_gaussians=cap))
    assert len(after) == max(min(cap, 6), 3)


def test_the_generator_decides():
    def means(seed: int) -> torch.Tensor:
        return run(build([LARGE] * 3), [2.0] * 3, seed=seed)[1].means

    assert torch.equal(means(1), means(1))
    assert not torch.equal(means(1), means(2))


def screen_points(gradient: list[list[float]], radii: list[float], size=(40, 30)) -> ScreenPoints:
    offset = torch.zeros(len(radii), 2, requires_grad=True)
    offset.grad = torch.tensor(gradient)
    return ScreenPoints(offset, torch.tensor(radii), size)


def test_statistics_are_means_over_the_views_that_drew():
    optimizer = GaussianOptimizer(random_gaussians(3), OptimizerConfig(), EXTENT)
    state = CONFIG.initial_state(optimizer.gaussians)
    for points in (
        screen_points([[0.3, 0.0], [0.0, 0.2], [0.0, 0.0]], [5.0, 2.0, 0.0]),
        screen_points([[0.1, 0.0], [0.0, 0.0], [0.0, 0.0]], [5.0, 0.0, 0.0]),
    ):
        observed = CONFIG.observe([points])
        step = DensityStep(1, EXTENT, False, observed, torch.tensor(True), torch.Generator())
        state = CONFIG.after_step(state, optimizer, step).state
    assert state["views"].tolist() == [2, 1, 0]
    # in units of half the image: 20 px wide, 15 px high
    torch.testing.assert_close(
        mean_gradients(state), torch.tensor([(0.3 + 0.1) * 20 / 2, 0.2 * 15, 0.0])
    )


def test_two_passes_of_a_view_add_up_and_count_once():
    rgb = screen_points([[0.1, 0.0], [0.0, 0.0]], [5.0, 0.0])
    thermal = screen_points([[0.0, 0.1], [0.1, 0.0]], [5.0, 1.0], size=(20, 10))
    state = CONFIG.observe([rgb, thermal])
    assert state["views"].tolist() == [1, 1]
    torch.testing.assert_close(mean_gradients(state), torch.tensor([0.1 * 20 + 0.1 * 5, 0.1 * 10]))


def test_the_schedule():
    config = AdaptiveDensityControl(start=100, stop=400, every=50, reset_every=150)
    assert [step for step in range(1, 1_000) if config.densifies_at(step)] == [
        150,
        200,
        250,
        300,
        350,
        400,
    ]
    assert [step for step in range(1, 1_000) if config.resets_at(step)] == [150, 300]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"every": 0}, "every .*not 0"),
        ({"max_gaussians": 0}, "max_gaussians .*not 0"),
        ({"prune_opacity": 0.5}, "prune_opacity < reset_opacity"),
    ],
)
def test_impossible_schedules_are_named(options, message):
    with pytest.raises(ConfigError, match=message):
        AdaptiveDensityControl(**options)
