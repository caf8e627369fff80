from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from mrgs.errors import ConfigError
from mrgs.method.adam import Adam, ParameterGroup
from mrgs.method.optimizer import GaussianOptimizer, OptimizerConfig, are_finite
from mrgs.scene import RGB, THERMAL, Gaussians
from tests.helpers.full_memory import FullAt
from tests.helpers.gaussians import NEAR_INFRARED, random_gaussians

EXTENT = 2.0


def give_gradients(gaussians: Gaussians, rows: torch.Tensor, seed: int) -> None:
    """Gradients that depend on the row's number in ``rows`` alone, so that a row can be
    followed."""
    for tensor in gaussians.tensors().values():
        generator = torch.Generator().manual_seed(seed)
        everything = torch.randn(100, *tensor.shape[1:], generator=generator)
        tensor.grad = everything[rows]


def rows_of(gaussians: Gaussians, rows: torch.Tensor) -> Gaussians:
    return Gaussians.from_tensors(
        {name: tensor.detach()[rows].clone() for name, tensor in gaussians.tensors().items()}
    )


def test_a_step_is_adams():
    gaussians, config = random_gaussians(6), OptimizerConfig()
    expected = gaussians.means.clone().requires_grad_()
    adam = torch.optim.Adam([expected], lr=config.means_at(0.5) * EXTENT, eps=1e-15)
    optimizer = GaussianOptimizer(gaussians, config, EXTENT)
    for seed in range(3):
        give_gradients(optimizer.gaussians, torch.arange(6), seed)
        expected.grad = optimizer.gaussians.means.grad.clone()
        optimizer.step(0.5)
        adam.step()
    torch.testing.assert_close(optimizer.gaussians.means, expected, rtol=1e-6, atol=1e-7)
    assert optimizer.gaussians.means.grad is None


def test_kept_rows_go_on_as_if_the_others_had_never_been():
    everything, kept = torch.arange(6), torch.tensor([4, 1, 3])
    start = random_gaussians(6)
    optimizer = GaussianOptimizer(rows_of(start, everything), OptimizerConfig(), EXTENT)
    alone = GaussianOptimizer(rows_of(start, kept), OptimizerConfig(), EXTENT)
    added = random_gaussians(2, seed=9)
    for seed in range(4):
        if seed == 2:
            optimizer.replace_rows(kept, added)
            assert len(optimizer.gaussians) == 5
        rows = everything if seed < 2 else torch.cat([kept, torch.tensor([50, 51])])
        give_gradients(optimizer.gaussians, rows, seed)
        give_gradients(alone.gaussians, kept, seed)
        optimizer.step(0.1 * seed)
        alone.step(0.1 * seed)
    state, expected = optimizer.state(), alone.state()
    assert set(state) == set(expected)
    for name, tensor in expected.items():
        found = state[name] if tensor.ndim == 0 else state[name][:3]
        torch.testing.assert_close(
            found, tensor, rtol=1e-6, atol=1e-7, msg=name
        )  # a row's place decides the rounding


def test_new_rows_start_without_moments():
    optimizer = GaussianOptimizer(random_gaussians(4), OptimizerConfig(), EXTENT)
    give_gradients(optimizer.gaussians, torch.arange(4), seed=0)
    optimizer.step(0.0)
    added = random_gaussians(2, seed=9)
    optimizer.replace_rows(torch.tensor([2]), added)
    state = optimizer.state()
    for name, tensor in optimizer.gaussians.tensors().items():
        assert tensor.requires_grad
        assert torch.equal(tensor[1:], added.tensors()[name])
        if tensor.numel() > 0:
            assert (state[f"adam.{name}.exp_avg"][0] != 0).all()
            assert (state[f"adam.{name}.exp_avg"][1:] == 0).all()
            assert (state[f"adam.{name}.exp_avg_sq"][1:] == 0).all()


@pytest.mark.parametrize("steps_before", [0, 2])
def test_empty_columns_survive(steps_before):
    """3DGS_RGB-T has no thermal opacity of its own and no embedding, MrGS no higher degrees of the
    temperature."""
    optimizer = GaussianOptimizer(
        random_gaussians(5, shares_opacity=True), OptimizerConfig(), EXTENT
    )
    for seed in range(steps_before):
        give_gradients(optimizer.gaussians, torch.arange(5), seed)
        optimizer.step(0.0)
    optimizer.replace_rows(torch.tensor([0, 2]), random_gaussians(1, shares_opacity=True))
    give_gradients(optimizer.gaussians, torch.arange(3), seed=7)
    optimizer.step(0.5)
    shapes = {name: tuple(tensor.shape) for name, tensor in optimizer.gaussians.tensors().items()}
    assert "opacity_logit.thermal" not in shapes
    assert shapes["sh_rest.thermal"] == (3, 0, 1)
    assert shapes["embedding"] == (3, 0)
    assert shapes["means"] == (3, 3)
    assert not any(key.startswith("adam.embedding") for key in optimizer.state())


@pytest.mark.parametrize("shares_opacity", [True, False])
def test_opacities_are_limited_and_forget_their_moments(shares_opacity):
    optimizer = GaussianOptimizer(random_gaussians(8, shares_opacity), OptimizerConfig(), EXTENT)
    optimizer.limit_opacities(0.6)  # before the first step there are no moments yet
    give_gradients(optimizer.gaussians, torch.arange(8), seed=0)
    optimizer.step(0.0)
    before = rows_of(optimizer.gaussians, torch.arange(8))
    optimizer.limit_opacities(0.3)
    gaussians, state = optimizer.gaussians, optimizer.state()
    limit = math.log(0.3 / 0.7)
    for name in ("opacity_logit.rgb", "opacity_logit.thermal")[: 1 if shares_opacity else 2]:
        logits = before.tensors()[name]
        torch.testing.assert_close(gaussians.tensors()[name], logits.clamp(max=limit))
        assert (logits < limit).any()
        assert (state[f"adam.{name}.exp_avg"] == 0).all()
        assert (state[f"adam.{name}.exp_avg_sq"] == 0).all()
    assert torch.equal(gaussians.means, before.means)
    assert (state["adam.means.exp_avg"] != 0).all()


def test_the_state_goes_on_exactly():
    def steps(optimizer: GaussianOptimizer, seeds: range) -> GaussianOptimizer:
        for seed in seeds:
            give_gradients(optimizer.gaussians, torch.arange(4), seed)
            optimizer.step(0.1 * seed)
        return optimizer

    whole = steps(
        GaussianOptimizer(random_gaussians(4), OptimizerConfig(), EXTENT), range(6)
    ).state()
    part = steps(
        GaussianOptimizer(random_gaussians(4), OptimizerConfig(), EXTENT), range(3)
    ).state()
    saved = {name: tensor.clone() for name, tensor in part.items()}
    gaussians = Gaussians.from_tensors(
        {name: tensor for name, tensor in saved.items() if not name.startswith("adam.")}
    )
    second = GaussianOptimizer(gaussians, OptimizerConfig(), EXTENT)
    second.load_moments(saved)
    found = steps(second, range(3, 6)).state()
    assert set(found) == set(whole)
    assert all(torch.equal(found[name], whole[name]) for name in whole)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_values_that_are_not_finite_are_found(value):
    optimizer = GaussianOptimizer(random_gaussians(4), OptimizerConfig(), EXTENT)
    loss = torch.tensor(1.0)
    assert are_finite(loss, optimizer.gradients())  # none yet
    assert not are_finite(value * loss, optimizer.gradients())
    give_gradients(optimizer.gaussians, torch.arange(4), seed=0)
    assert are_finite(loss, optimizer.gradients())
    optimizer.gaussians.sh_rest[RGB].grad[3, 7, 1] = value
    assert not are_finite(loss, optimizer.gradients())
    optimizer.zero_grad()
    assert are_finite(loss, optimizer.gradients())


def test_a_step_that_does_not_count_changes_nothing_and_one_that_does_the_same_bits():
    """Before the first step too, when there are no moments."""
    optimizer, plain = (
        GaussianOptimizer(random_gaussians(4), OptimizerConfig(), EXTENT) for _ in range(2)
    )
    good = torch.tensor(True)
    for seed in range(3):
        before = {name: tensor.clone() for name, tensor in optimizer.gaussians.tensors().items()}
        give_gradients(optimizer.gaussians, torch.arange(4), seed)
        optimizer.gaussians.means.grad[0, 0] = float("nan")
        optimizer.step(0.5, ~good)
        after = optimizer.gaussians.tensors()
        assert all(torch.equal(after[name].detach(), before[name].detach()) for name in before)
        assert all(gradient.numel() == 0 for gradient in optimizer.gradients())
        for each, known in ((optimizer, good), (plain, None)):
            give_gradients(each.gaussians, torch.arange(4), seed)
            each.step(0.5, known)
    expected, found = plain.state(), optimizer.state()
    assert set(found) == set(expected)
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []


def test_rows_that_memory_does_not_suffice_for_leave_the_optimizer_as_it_was():
    optimizer = GaussianOptimizer(random_gaussians(4), OptimizerConfig(), EXTENT)
    give_gradients(optimizer.gaussians, torch.arange(4), seed=0)
    optimizer.step(0.5)
    before = {name: tensor.clone() for name, tensor in optimizer.state().items()}
    kept, added = torch.tensor([0, 2]), random_gaussians(3)
    for tensors in range(20):
        with pytest.raises(torch.cuda.OutOfMemoryError), FullAt(tensors):
            optimizer.replace_rows(kept, added)
        after = optimizer.state()
        assert set(after) == set(before)
        assert all(torch.equal(after[name], before[name]) for name in before)


def test_learning_rate_of_the_means_decays_between_its_ends():
    config = OptimizerConfig(means=1e-2, means_final=1e-4)
    assert config.means_at(0.0) == pytest.approx(1e-2)
    assert config.means_at(0.5) == pytest.approx(1e-3)
    assert config.means_at(1.0) == pytest.approx(1e-4)


def test_every_parameter_has_its_learning_rate():
    config = OptimizerConfig(
        opacities=1.0, sh_dc=2.0, sh_rest=3.0, temperature_dc=4.0, temperature_rest=5.0
    )
    names = random_gaussians(1, modalities=(RGB, THERMAL, NEAR_INFRARED)).tensors()
    assert {name: config.of(name) for name in names} == {
        "means": config.means, "quats": config.quats, "log_scales": config.log_scales,
        "opacity_logit.rgb": 1.0, "opacity_logit.thermal": 1.0, "opacity_logit.nir": 1.0,
        "sh_dc.rgb": 2.0, "sh_dc.thermal": 4.0, "sh_dc.nir": 2.0,
        "sh_rest.rgb": 3.0, "sh_rest.thermal": 5.0, "sh_rest.nir": 3.0,
        "embedding": config.embedding,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"quats": -1e-3}, "quats .* -0.001"),
        ({"heads": float("nan")}, "heads .* nan"),
        ({"means_final": 0.0}, "means_final"),
        ({"slowdown_from": -0.1}, "slowdown_from .* -0.1"),
        ({"slowdown_to": 1.5}, "slowdown_to .* 1.5"),
        ({"slowdown_to": 0.0}, "slowdown_to .* above"),
    ],
)
def test_impossible_learning_rates_are_named(options, named):
    with pytest.raises(ConfigError, match=named):
        replace(OptimizerConfig(), **options)


def test_rates_fall_at_the_end_alone():
    config = OptimizerConfig(slowdown_from=0.5, slowdown_to=0.01)
    assert [config.slowdown_at(progress) for progress in (0.0, 0.5, 0.75, 1.0)] == pytest.approx(
        [1, 1, 0.1, 0.01]
    )
    assert OptimizerConfig().slowdown_at(1.0) == 1.0
    optimizer = GaussianOptimizer(random_gaussians(6), config, EXTENT)
    give_gradients(optimizer.gaussians, torch.arange(6), seed=0)
    before = optimizer.gaussians.quats.detach().clone()
    optimizer.step(1.0)
    moved = (optimizer.gaussians.quats.detach() - before).abs()
    torch.testing.assert_close(
        moved, torch.full_like(moved, 0.01 * config.quats), rtol=0.02, atol=1e-8
    )


def test_all_groups_are_slowed_alike():
    adam = Adam(ParameterGroup([torch.zeros(1, requires_grad=True)], rate) for rate in (1.0, 4.0))
    for factor in (0.5, 0.25):
        adam.set_rates(factor)
        assert [group.rate for group in adam.groups] == [factor, 4 * factor]


def test_the_bits_are_those_of_torchs_fused_adam():
    start = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    ours, theirs = (start.clone().requires_grad_() for _ in range(2))
    idle = torch.zeros(2, requires_grad=True)
    adam = Adam([ParameterGroup([ours, idle], 0.01)], epsilon=1e-15)
    expected = torch.optim.Adam([theirs], lr=0.01, eps=1e-15, fused=True)
    for seed in range(5):
        gradient = torch.randn(50, 3, generator=torch.Generator().manual_seed(seed))
        ours.grad, theirs.grad = gradient, gradient.clone()
        adam.step()
        expected.step()
    assert torch.equal(ours, theirs)
    found = adam.moments({"a": ours, "b": idle})
    assert set(found) == {"a.step", "a.exp_avg", "a.exp_avg_sq"}
    assert all(
        torch.equal(found[f"a.{name}"], each) for name, each in expected.state[theirs].items()
    )
