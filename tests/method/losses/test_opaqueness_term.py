"""L_opaque as a training sees it: from which camera light and heat are compared."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

from mrgs.method.losses.photometric import opaqueness_loss
from mrgs.method.losses.term import LossContext, SceneScale
from mrgs.method.losses.terms import Opaqueness
from mrgs.rasterizer.contract import Dilation
from mrgs.scene import RGB, THERMAL, Blend, Camera, Modality, Rendering
from tests.helpers.gaussians import random_gaussians
from tests.helpers.views import not_rendered, small_camera

HEIGHT, WIDTH = 6, 8


def blend(modality: Modality, depth: float, moves: bool = False) -> Blend:
    image = torch.zeros(HEIGHT, WIDTH, modality.channels)
    alpha = torch.ones(HEIGHT, WIDTH)
    return Blend(image, torch.full((HEIGHT, WIDTH), depth).requires_grad_(moves), alpha)


def context(
    cameras: Mapping[Modality, Camera],
    light: float,
    heat: Blend,
    render=not_rendered,
    shares_opacity: bool = False,
) -> LossContext:
    rendering = Rendering({RGB: blend(RGB, light), THERMAL: heat})
    gaussians, scale = random_gaussians(3, shares_opacity), SceneScale(3.0, None)
    return LossContext(rendering, rendering, {}, cameras, gaussians, Dilation(), scale, render)


def loss_of(light: float, heat: Blend) -> Tensor:
    alpha = torch.ones(HEIGHT, WIDTH)
    return opaqueness_loss(alpha, alpha, heat.depth, torch.full_like(alpha, light))


def test_one_camera_has_both() -> None:
    both = dict.fromkeys((RGB, THERMAL), small_camera(0.0))
    heat = blend(THERMAL, 5.0)
    assert Opaqueness(0.1).value(context(both, 2.0, heat)) == loss_of(2.0, heat)


@pytest.mark.parametrize("photos", [{RGB, THERMAL}, {THERMAL}], ids=["two cameras", "no RGB photo"])
def test_light_is_rendered_by_the_thermal_camera(photos: set[Modality]) -> None:
    cameras = {RGB: small_camera(0.0), THERMAL: small_camera(0.2)}
    asked = []

    def render(others: Mapping[Modality, Camera]) -> Rendering:
        asked.append((dict(others), torch.is_grad_enabled()))
        return Rendering({RGB: blend(RGB, 3.0)})

    heat = blend(THERMAL, 5.0, moves=True)
    seen = {each: cameras[each] for each in photos}
    value = Opaqueness(0.1).value(context(seen, 2.0, heat, render))
    assert asked == [({RGB: cameras[THERMAL]}, False)]
    assert value is not None
    assert value == loss_of(3.0, heat)
    (gradient,) = torch.autograd.grad(value, heat.depth)
    assert (gradient > 0).all()


def test_without_a_thermal_photo_or_with_one_opacity_there_is_nothing_to_compare() -> None:
    heat = blend(THERMAL, 5.0)
    apart = {RGB: small_camera(0.0), THERMAL: small_camera(0.2)}
    assert Opaqueness(0.1).value(context({RGB: apart[RGB]}, 2.0, heat)) is None
    assert Opaqueness(0.1).value(context(apart, 2.0, heat, shares_opacity=True)) is None
