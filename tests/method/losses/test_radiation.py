from __future__ import annotations

import math

import pytest
import torch

from mrgs.errors import ConfigError
from mrgs.method.losses.radiation import (
    STEFAN_BOLTZMANN,
    DepthUncertainty,
    RadiationConfig,
    boltzmann_loss,
    boltzmann_weight,
    normalise_radiation,
    thermal_radiation,
)
from mrgs.scene import TemperatureRange

RANGE = TemperatureRange(min_c=-10.0, max_c=50.0)


def plane(height: int = 14, width: int = 16, seed: int = 0) -> torch.Tensor:
    return torch.rand(
        height, width, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)
    )


def test_radiation_is_that_of_a_black_body_seen_from_a_distance():
    target = torch.tensor([[0.5]], dtype=torch.float64)
    depth = torch.tensor([[2.0]], dtype=torch.float64)
    kelvin = 20 + 273.15
    assert thermal_radiation(target, depth, 1.0, RANGE).item() == pytest.approx(
        5.670374419e-8 * kelvin**4 / 4
    )
    assert thermal_radiation(target, depth, 1.0, None).item() == pytest.approx(
        STEFAN_BOLTZMANN * 0.5**4 / 4
    )


def test_depth_has_a_floor():
    target, depth = plane(2, 2), torch.zeros(2, 2, dtype=torch.float64)
    assert torch.equal(
        thermal_radiation(target, depth, 4.0, RANGE),
        thermal_radiation(target, depth + 0.004, 4.0, RANGE),
    )


def test_gradients():
    target, depth = plane(), (1 + plane(seed=1)).requires_grad_()
    radiation = thermal_radiation(target, depth, 1.0, RANGE).detach().requires_grad_()
    uncertainty = plane(seed=2).requires_grad_()
    thermal = plane(seed=3).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda depth: thermal_radiation(target, depth, 1.0, RANGE), depth
    )
    scaled = normalise_radiation(radiation).detach().requires_grad_()
    assert torch.autograd.gradcheck(boltzmann_loss, (thermal, scaled, uncertainty))


@pytest.mark.parametrize("size", [(14, 16), (300, 401)])
def test_normalised_radiation_spans_zero_to_one(size):
    scaled = normalise_radiation(100 + 50 * plane(*size))
    assert scaled.min() == 0
    assert scaled.max() == 1
    assert ((scaled == 0) | (scaled == 1)).double().mean() < 0.05


@pytest.mark.parametrize("masked", [False, True])
def test_nothing_is_gained_by_multiplying_all_depths(masked):
    target, uncertainty = plane(), plane(seed=2)
    valid = plane(seed=3) > 0.3 if masked else None
    factor = torch.ones((), dtype=torch.float64, requires_grad=True)

    def loss(factor):
        radiation = thermal_radiation(target, factor * (1 + plane(seed=1)), 1.0, RANGE)
        return boltzmann_loss(target, normalise_radiation(radiation, valid), uncertainty, valid)

    torch.testing.assert_close(loss(factor), loss(3 * factor))
    (gradient,) = torch.autograd.grad(loss(factor), factor)
    assert gradient.abs() < 1e-12


@pytest.mark.parametrize("masked", [False, True])
def test_gradient_of_the_normalisation(masked):
    valid = plane(seed=3) > 0.3 if masked else None
    radiation = (1 + plane()).requires_grad_()
    inside = (normalise_radiation(radiation.detach(), valid) - 0.5).abs() < 0.49
    assert torch.autograd.gradcheck(
        lambda radiation: normalise_radiation(radiation, valid)[inside], radiation
    )


def test_one_near_pixel_does_not_set_the_scale():
    depth = 2 + plane(40, 50, seed=1)
    near = depth.clone()
    near[20, 25] = 0.02
    target = plane(40, 50)
    maps = [normalise_radiation(thermal_radiation(target, d, 1.0, RANGE)) for d in (depth, near)]
    others = torch.ones_like(depth, dtype=torch.bool)
    others[20, 25] = False
    difference = (maps[1] - maps[0])[others].abs().max()
    assert difference < 0.02
    assert maps[1][20, 25] == 1


def test_no_pixel_carries_the_gradient_of_the_whole_map():
    depth = 2 + plane(40, 50, seed=1)
    depth[20, 25] = 0.02
    depth.requires_grad_()
    thermal, uncertainty = plane(40, 50, seed=2), torch.zeros(40, 50, dtype=torch.float64)
    radiation = normalise_radiation(thermal_radiation(plane(40, 50), depth, 1.0, RANGE))
    (gradient,) = torch.autograd.grad(boltzmann_loss(thermal, radiation, uncertainty), depth)
    assert gradient[20, 25] == 0  # 0.9 of all gradient with the largest value as the scale
    assert gradient.abs().max() < 0.1 * gradient.abs().sum()


def test_normalisation_looks_at_valid_pixels_alone():
    radiation = 1 + plane()
    radiation[0] = 1e9
    valid = torch.ones_like(radiation, dtype=torch.bool)
    valid[0] = False
    scaled = normalise_radiation(radiation, valid)[valid]
    assert scaled.median() > 0.2
    assert scaled.max() == 1


def test_without_a_valid_pixel_the_normalised_radiation_and_its_gradient_are_zero():
    radiation = (1 + plane()).requires_grad_()
    scaled = normalise_radiation(radiation, torch.zeros_like(radiation, dtype=torch.bool))
    assert (scaled == 0).all()
    (gradient,) = torch.autograd.grad(scaled.sum(), radiation)
    assert (gradient == 0).all()


@pytest.mark.parametrize("temperature", [RANGE, None])
@pytest.mark.parametrize(
    "depth", [torch.zeros(12, 12), torch.full((12, 12), 3.0)], ids=["no depth", "flat depth"]
)
@pytest.mark.parametrize("level", [0.0, 0.5])
def test_degenerate_inputs_have_finite_values_and_gradients(temperature, depth, level):
    torch.manual_seed(0)
    depth = depth.clone().requires_grad_()
    thermal = torch.full((12, 12), level, requires_grad=True)
    radiation = normalise_radiation(thermal_radiation(thermal.detach(), depth, 5.0, temperature))
    loss = boltzmann_loss(thermal, radiation, DepthUncertainty()(depth, 5.0))
    assert loss.isfinite()
    for gradient in torch.autograd.grad(loss, (depth, thermal)):
        assert gradient.isfinite().all()


def test_uncertainty_is_a_convolution_of_the_scaled_depth():
    torch.manual_seed(0)
    module = DepthUncertainty().double()
    depth = plane(9, 10)
    expected = torch.nn.functional.conv2d(
        depth[None, None] / 3, module.psi.weight, module.psi.bias, padding=1
    )
    torch.testing.assert_close(module(depth, 3.0), expected[0, 0].sigmoid())


@pytest.mark.parametrize("masked", [False, True])
def test_the_loss_is_that_of_plain_torch(masked):
    inputs = [plane(70, 20, seed=seed).requires_grad_() for seed in (0, 1, 2)]
    valid = plane(70, 20, seed=3) > 0.3 if masked else None
    loss, expected = (f(*inputs, valid) for f in (boltzmann_loss, boltzmann_loss.plain))
    torch.testing.assert_close(loss, expected)
    torch.testing.assert_close(
        torch.autograd.grad(loss, inputs), torch.autograd.grad(expected, inputs)
    )


def test_agreement_costs_the_uncertainty_alone():
    thermal = plane()
    loss = boltzmann_loss(thermal, thermal, torch.full_like(thermal, 0.3))
    assert loss.item() == pytest.approx(0.3)


def test_uncertainty_forgives_disagreement():
    thermal = plane()
    disagreement = boltzmann_loss(thermal, 1 - thermal, torch.zeros_like(thermal)).item()
    assert disagreement > 1
    forgiven = boltzmann_loss(thermal, 1 - thermal, torch.full_like(thermal, 0.5)).item()
    assert forgiven == pytest.approx(disagreement / math.exp(0.5) + 0.5)


def test_invalid_pixels_do_not_count():
    thermal, radiation, uncertainty = plane(), plane(seed=1), plane(seed=2)
    valid = plane(seed=3) > 0.3
    spoilt = torch.where(valid, radiation, 1e6)
    torch.testing.assert_close(
        boltzmann_loss(thermal, spoilt, uncertainty, valid),
        boltzmann_loss(thermal, radiation, uncertainty, valid),
    )


def test_weight_decays_between_its_ends():
    config = RadiationConfig()
    for step, weight in (
        (0, 0.05),
        (500, 0.05),
        (7750, math.sqrt(0.05 * 0.01)),
        (15_000, 0.01),
        (30_000, 0.01),
    ):
        assert boltzmann_weight(step, config) == pytest.approx(weight)


def test_impossible_schedules_are_named():
    with pytest.raises(ConfigError, match=r"L_boltz .*0\.0 and 0\.01"):
        RadiationConfig(start=0.0)
    with pytest.raises(ConfigError, match=r"L_boltz .*step 500"):
        RadiationConfig(decay_until=500)
