"""L_boltz as a training sees it: what moves what, and which depth it prefers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from mrgs.data import load_scene
from mrgs.method.losses.radiation import RadiationConfig
from mrgs.method.losses.term import LossContext, SceneScale
from mrgs.method.losses.terms import Boltzmann
from mrgs.rasterizer.dilation import AS_PUBLISHED
from mrgs.scene import (
    RGB,
    THERMAL,
    Blend,
    Camera,
    Modality,
    Pixels,
    Rendering,
    TemperatureRange,
    View,
)
from tests.helpers.gaussians import random_gaussians
from tests.helpers.views import not_rendered

SCENE = Path(__file__).parents[3] / "examples/tabletop"


class Exact(NamedTuple):
    """What a perfect model shows from a held-out view."""

    view: View
    temperatures: Tensor
    depth: Tensor


@pytest.fixture(scope="module")
def exact() -> tuple[list[Exact], SceneScale]:
    scene = load_scene(SCENE)
    assert scene.temperature is not None
    shown = []
    for view in scene.eval[::3]:
        celsius, depth = (
            torch.from_numpy(np.array(Image.open(SCENE / f"truth/{kind}/{view.name}.tiff")))
            for kind in ("temperature", "depth")
        )
        values = (celsius - scene.temperature.min_c) / scene.temperature.span_c
        shown.append(Exact(view, values, torch.where(depth > 0, depth, depth.max())))
    return shown, SceneScale(scene.extent, scene.temperature)


def context_of(shown: Exact, scale: SceneScale, depth: Tensor, rgb_depth: Tensor) -> LossContext:
    view, image = shown.view, shown.temperatures[..., None]
    opaque = torch.ones_like(depth)
    rendering = Rendering(
        {
            RGB: Blend(image.expand(-1, -1, 3), rgb_depth, opaque),
            THERMAL: Blend(image, depth, opaque),
        }
    )
    photos = {each: posed.load() for each, posed in view.images.items()}
    gaussians, cameras = random_gaussians(3), view.cameras
    return LossContext(
        rendering, rendering, photos, cameras, gaussians, AS_PUBLISHED, scale, not_rendered
    )


def confident(config: RadiationConfig) -> Boltzmann:
    """L_boltz whose uncertainty is the same everywhere."""
    term = Boltzmann(config, 1e-3)
    assert term.learned is not None
    for parameter in term.learned.parameters():
        parameter.data.zero_()
    return term


def with_floaters(depth: Tensor, count: int, size: int, factor: float) -> Tensor:
    """The depth with squares that float in front of the surfaces."""
    generator = torch.Generator().manual_seed(0)
    changed = depth.clone()
    for _ in range(count):
        y, x = (
            int(torch.randint(0, side - size, (1,), generator=generator)) for side in depth.shape
        )
        changed[y : y + size, x : x + size] *= factor
    return changed


WRONG = {
    "constant": lambda depth: torch.full_like(depth, depth.mean().item()),
    "half as deep about its mean": lambda depth: depth.mean() + 0.5 * (depth - depth.mean()),
    "a floater": lambda depth: with_floaters(depth, 1, 8, 0.3),
    "many floaters": lambda depth: with_floaters(depth, 20, 8, 0.5),
    "one near pixel": lambda depth: with_floaters(depth, 1, 1, 0.1),
    "noise": lambda depth: (
        depth * (1 + 0.05 * torch.randn(depth.shape, generator=torch.Generator().manual_seed(1)))
    ),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_the_exact_depth_costs_least_where_a_pixel_sees_the_whole_surface(exact, wrong) -> None:
    views, scale = exact
    term = confident(RadiationConfig(area="pixel"))

    @torch.no_grad()
    def loss(change) -> Tensor:
        values = [
            term.value(context_of(each, scale, change(each.depth), each.depth)) for each in views
        ]
        return torch.stack([value for value in values if value is not None]).mean()

    assert loss(lambda depth: depth) < loss(WRONG[wrong])


def small_context(**changes) -> tuple[LossContext, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(20, 24, 1, generator=generator).requires_grad_()
    depth = (1 + torch.rand(20, 24, generator=generator)).requires_grad_()
    alpha = changes.get("alpha", torch.ones(20, 24))
    rgb = Blend(image.detach().expand(-1, -1, 3), depth.detach() + 0.1, alpha)
    rendering = Rendering({RGB: rgb, THERMAL: Blend(image, depth, alpha)})
    view = load_scene(SCENE).train[0]
    cameras = changes.get("cameras", view.cameras)
    photos = {THERMAL: Pixels(torch.rand(20, 24, 1, generator=generator))}
    scale = SceneScale(3.0, TemperatureRange(10.0, 60.0))
    gaussians = random_gaussians(3)
    context = LossContext(
        rendering, rendering, photos, cameras, gaussians, AS_PUBLISHED, scale, not_rendered
    )
    return context, image, depth


def test_the_uncertainty_does_not_move_the_depth() -> None:
    context, _, depth = small_context()
    term = Boltzmann(RadiationConfig(depth_gradient=False), 1e-3)
    value = term.value(context)
    assert value is not None
    (gradient,) = torch.autograd.grad(value, depth, allow_unused=True)
    assert gradient is None


@pytest.mark.parametrize("attached", ["image", "depth", "both"])
def test_what_l_boltz_moves_can_be_chosen(attached) -> None:
    context, image, depth = small_context()
    config = RadiationConfig(image_gradient=attached != "depth", depth_gradient=attached != "image")
    value = Boltzmann(config, 1e-3).value(context)
    assert value is not None
    found = torch.autograd.grad(value, (image, depth), allow_unused=True)
    assert [gradient is not None for gradient in found] == [
        attached != "depth",
        attached != "image",
    ]


def test_pixels_that_show_no_surface_do_not_count() -> None:
    alpha = torch.ones(20, 24)
    alpha[:8] = 0.4
    context, image, depth = small_context(alpha=alpha)
    value = confident(RadiationConfig()).value(context)
    assert value is not None
    for gradient in torch.autograd.grad(value, (image, depth)):
        assert (gradient[:8] == 0).all()
        assert (gradient[8:] != 0).any()


def test_where_the_cameras_differ_the_surface_is_seen_from_the_thermal_one() -> None:
    view = load_scene(SCENE).train[0]
    other = {RGB: view.cameras[RGB], THERMAL: view.cameras[RGB].resized(64, 48)}
    shared, *_ = small_context()
    context, *_ = small_context(cameras=other)
    asked = []

    def render(cameras: Mapping[Modality, Camera]) -> Rendering:
        asked.append(dict(cameras))
        return Rendering({RGB: shared.rendering[RGB]})

    term = confident(RadiationConfig(area="pixel"))
    value = term.value(replace(context, render=render))
    assert asked == [{RGB: other[THERMAL]}]
    torch.testing.assert_close(value, term.value(shared))
