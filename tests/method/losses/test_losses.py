from __future__ import annotations

import math

import pytest
import torch

from mrgs.errors import ConfigError
from mrgs.method.losses.photometric import (
    LossConfig,
    opaqueness_loss,
    photometric_loss,
    total_loss,
)
from mrgs.method.losses.smoothness import similarity_of, smoothness_loss, total_variation
from mrgs.method.losses.ssim import ssim_map


def image(height: int, width: int, channels: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(height, width, channels, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("channels", [1, 3])
def test_photometric_loss_is_l1_and_dssim(channels):
    render, target = image(20, 25, channels), image(20, 25, channels, seed=1)
    dissimilarity = 1 - ssim_map(render.permute(2, 0, 1), target.permute(2, 0, 1)).mean()
    expected = 0.8 * (render - target).abs().mean() + 0.2 * dissimilarity
    torch.testing.assert_close(photometric_loss(render, target, None, 0.2), expected)
    torch.testing.assert_close(
        photometric_loss(render, target, None, 0.0), (render - target).abs().mean()
    )


def test_equal_images_cost_nothing():
    target = image(20, 25, 3)
    assert photometric_loss(target, target, None, 0.2).abs() < 1e-6


def test_all_pixels_valid_is_the_same_as_no_mask():
    render, target = image(20, 25, 3), image(20, 25, 3, seed=1)
    everywhere = torch.ones(20, 25, dtype=torch.bool)
    torch.testing.assert_close(
        photometric_loss(render, target, everywhere, 0.2),
        photometric_loss(render, target, None, 0.2),
    )


def test_invalid_pixels_neither_cost_nor_pull():
    target = image(20, 25, 3, seed=1)
    valid = torch.zeros(20, 25, dtype=torch.bool)
    valid[:, :10] = True
    render = torch.where(valid[:, :, None], target, torch.tensor(9.0)).requires_grad_()
    loss = photometric_loss(render, target, valid, 0.2)
    assert loss.abs() < 1e-6

    shifted = (target + 0.1).requires_grad_()
    (gradient,) = torch.autograd.grad(photometric_loss(shifted, target, valid, 0.2), shifted)
    assert (gradient[~valid] == 0).all()
    assert (gradient[valid] != 0).all()


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_invalid_pixels_may_hold_anything(value):
    render, target = image(20, 25, 3), image(20, 25, 3, seed=1)
    valid = torch.zeros(20, 25, dtype=torch.bool)
    valid[:, :10] = True
    broken = torch.where(valid[:, :, None], target, torch.tensor(value))
    torch.testing.assert_close(
        photometric_loss(render, broken, valid, 0.2), photometric_loss(render, target, valid, 0.2)
    )


def test_nothing_valid_costs_nothing():
    render = image(12, 12, 1).requires_grad_()
    loss = photometric_loss(
        render, image(12, 12, 1, seed=1), torch.zeros(12, 12, dtype=torch.bool), 0.2
    )
    assert loss == 0
    (gradient,) = torch.autograd.grad(loss, render)
    assert (gradient == 0).all()


@pytest.mark.slow
def test_photometric_gradient():
    render, target = image(6, 7, 2).double().requires_grad_(), image(6, 7, 2, seed=1).double()
    assert torch.autograd.gradcheck(
        lambda render: photometric_loss(render, target, None, 0.2), render
    )


def test_constants_are_smooth():
    constant, depth = torch.full((8, 9, 3), 0.4), torch.full((8, 9), 5.0)
    assert smoothness_loss(constant, depth, None, 2.0, 1.0, LossConfig()) == 0


def test_smoothness_is_the_mean_of_first_differences():
    ramp = 0.1 * torch.arange(6).expand(5, 6)
    depth = 4 * torch.arange(5)[:, None].expand(5, 6)
    config = LossConfig(smooth_depth=0.5)
    loss = smoothness_loss(ramp[:, :, None], depth, None, 8.0, 2.0, config)
    assert loss.item() == pytest.approx(2.0 * 0.1 + 0.5 * 4 / 8)


def test_pixels_are_alike_where_another_image_does_not_change():
    guide = torch.zeros(3, 4, 3)
    guide[:, 2:] = torch.tensor([0.0, 0.1, 0.2])
    rows, columns = similarity_of(guide)
    assert (rows == 1).all()
    expected = torch.tensor([1.0, math.exp(-5), 1.0]).expand(3, 3)
    torch.testing.assert_close(columns, expected)
    torch.testing.assert_close(similarity_of(guide, 0.25)[1], 0.25 + 0.75 * expected)
    image = torch.zeros(3, 4, 1)
    image[:, 2:] = 0.5
    assert total_variation(image, None, rows, columns).item() == pytest.approx(
        math.exp(-5) * total_variation(image).item()
    )


@pytest.mark.parametrize("shape", [(1, 1, 2), (1, 6, 2), (6, 1, 2), (40, 15, 3), (40, 15, 1)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
def test_the_variation_is_that_of_plain_torch(shape, masked, weighted):
    values = image(*shape).requires_grad_()
    valid = image(*shape, seed=1)[..., 0] > 0.3 if masked else None
    weights = similarity_of(image(*shape, seed=2), 0.3) if weighted else (None, None)
    loss, expected = (f(values, valid, *weights) for f in (total_variation, total_variation.plain))
    torch.testing.assert_close(loss, expected)
    gradients = [torch.autograd.grad(3 * value, values)[0] for value in (loss, expected)]
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("dssim", [0.0, 0.2])
@pytest.mark.parametrize("width", [0.0, 0.2])
def test_the_photometric_loss_is_that_of_plain_torch(masked, dssim, width):
    render, target = image(70, 25, 3).requires_grad_(), image(70, 25, 3, seed=1)
    valid = image(70, 25, 1, seed=2)[..., 0] > 0.3 if masked else None
    loss, expected = (
        f(render, target, valid, dssim, width) for f in (photometric_loss, photometric_loss.plain)
    )
    torch.testing.assert_close(loss, expected)
    gradients = [torch.autograd.grad(value, render)[0] for value in (loss, expected)]
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("loss", [photometric_loss, photometric_loss.plain])
def test_a_huber_loss_is_quadratic_below_its_width_and_linear_above(loss):
    """δ = 0.1: 0.05² / 0.2 and 0.3 − 0.05; the same slope on both sides of δ."""
    target = torch.zeros(1, 2, 1)
    render = torch.tensor([[[0.05], [-0.3]]], requires_grad=True)
    value = loss(render, target, None, 0.0, 0.1)
    assert value.item() == pytest.approx((0.0125 + 0.25) / 2)
    (gradient,) = torch.autograd.grad(value, render)
    torch.testing.assert_close(2 * gradient.flatten(), torch.tensor([0.5, -1.0]))


def test_flat_images_have_no_step():
    flat = torch.full((20, 9, 3), 0.4, requires_grad=True)
    (gradient,) = torch.autograd.grad(total_variation(flat), flat)
    assert (gradient == 0).all()


def test_a_value_that_is_not_finite_is_not_hidden():
    spoilt = image(20, 9, 3)
    spoilt[10, 5, 1] = float("nan")
    assert total_variation(spoilt).isnan()
    assert photometric_loss(spoilt, image(20, 9, 3), None, 0.2).isnan()


def test_total_loss_weighs_its_terms():
    values = {"rgb": 1.0, "thermal": 2.0, "smooth": 3.0, "boltzmann": 4.0}
    terms = {name: torch.tensor(value) for name, value in values.items()}
    weights = {"rgb": 1.0, "thermal": 1.0, "smooth": 0.6, "boltzmann": 0.05}
    assert total_loss(terms, weights).item() == pytest.approx(1 + 2 + 0.6 * 3 + 0.05 * 4)
    assert total_loss({"thermal": torch.tensor(2.0)}, weights).item() == 2


def test_total_loss_refuses_what_it_does_not_know():
    with pytest.raises(KeyError, match="tempreature"):
        total_loss({"tempreature": torch.tensor(1.0)}, {"temperature": 1.0})
    with pytest.raises(ValueError, match="one term"):
        total_loss({}, {})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dssim": 1.5}, r"dssim .*1\.5"),
        ({"smooth": -1.0}, r"smooth .*-1\.0"),
        ({"opaque": float("nan")}, "opaque .*nan"),
    ],
)
def test_impossible_weights_are_named(options, message):
    with pytest.raises(ConfigError, match=message):
        LossConfig(**options)


def test_smoothness_ignores_pixels_that_do_not_count():
    generator = torch.Generator().manual_seed(0)
    image, depth = (torch.rand(8, 9, c, generator=generator) for c in (3, 1))
    valid = torch.rand(8, 9, generator=generator) > 0.3
    losses = []
    for value in (0.0, 7.0):
        filled = [torch.where(valid[:, :, None], tensor, value) for tensor in (image, depth)]
        losses.append(smoothness_loss(filled[0], filled[1][..., 0], valid, 1.0, 1.0, LossConfig()))
    assert losses[0] == losses[1]
    assert losses[0] > 0


def opaqueness(alpha_thermal, alpha_rgb, depth_thermal, depth_rgb):
    """L_opaque of a row of pixels, and its gradients in the thermal blend."""
    heat, heat_depth = (
        torch.tensor([values], requires_grad=True) for values in (alpha_thermal, depth_thermal)
    )
    light, light_depth = (
        torch.tensor([values], requires_grad=True) for values in (alpha_rgb, depth_rgb)
    )
    loss = opaqueness_loss(heat, light, heat_depth, light_depth)
    loss.backward()
    assert light.grad is None
    assert light_depth.grad is None
    return loss.item(), heat.grad[0].tolist(), heat_depth.grad[0].tolist()


def test_heat_is_blocked_where_light_is():
    loss, by_alpha, by_depth = opaqueness(
        [0.6, 1.0, 0.9], [1.0, 0.2, 0.9], [1.2, 2.0, 1.8], [2.0, 0.4, 1.8]
    )
    assert loss == pytest.approx(0.4 / 3)
    assert by_alpha == pytest.approx([-1 / 3, 0, 0])
    assert by_depth == [0, 0, 0]


def test_heat_does_not_come_from_behind_what_light_shows_and_seldom_from_before_it():
    """A wall at 2, seen by heat at 2.5 behind it, at 1.5 before it, far behind it, and where light
    is not blocked."""
    loss, _, by_depth = opaqueness(
        [1.0, 1.0, 1.0, 1.0], [1.0, 1.0, 1.0, 0.4], [2.5, 1.5, 8.0, 9.0], [2.0, 2.0, 2.0, 0.8]
    )
    assert loss == pytest.approx((0.2 + 0.1 * 0.25 + 0.75 + 0) / 4)
    assert by_depth == pytest.approx([2 / 2.5**2 / 4, -0.1 / 2 / 4, 2 / 8.0**2 / 4, 0])
