from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from mrgs.render import Rendering
from mrgs.scene import Camera, Pixels, PosedImage, TemperatureRange, View


def posed(values: Tensor, valid: Tensor | None = None) -> PosedImage:
    height, width = values.shape[:2]
    K = torch.tensor(
        [[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], dtype=torch.float64
    )
    camera = Camera(K, torch.eye(4, dtype=torch.float64), width, height)
    return PosedImage(camera, lambda: Pixels(values, valid))


@pytest.fixture
def celsius() -> TemperatureRange:
    return TemperatureRange(10.0, 30.0)


@pytest.fixture
def make_view() -> Callable[..., View]:
    """A view with an RGB image of 24×32 and a thermal image of 18×24, smooth ramps with a warm
    square."""

    def make(
        name: str = "eval_0", rgb: bool = True, thermal: bool = True, valid: Tensor | None = None
    ) -> View:
        ramp = torch.linspace(0.1, 0.6, 32).expand(24, 32)
        color = torch.stack([ramp, 0.9 - ramp, ramp.square()], dim=-1)
        heat = torch.linspace(0.2, 0.3, 24).repeat(18, 1)[..., None]
        heat[5:12, 8:16] = 0.8
        return View(name, posed(color) if rgb else None, posed(heat, valid) if thermal else None)

    return make


@pytest.fixture
def render_with_error() -> Callable[[View], Rendering]:
    """A model whose colours are 0.1 too bright and whose temperatures are 0.05 (1 °C) too high, at
    a depth of 2."""

    def render(view: View) -> Rendering:
        rgb = view.rgb.load().values + 0.1 if view.rgb else None
        thermal = view.thermal.load().values + 0.05 if view.thermal else None
        depths = [
            None if image is None else torch.full(image.shape[:2], 2.0) for image in (rgb, thermal)
        ]
        return Rendering(rgb, depths[0], thermal, depths[1])

    return render
