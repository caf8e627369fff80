"""Views and renderings whose pixels are known."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from mrgs.scene import (
    RGB,
    THERMAL,
    Blend,
    Camera,
    Modality,
    Pixels,
    PosedImage,
    Rendering,
    TemperatureRange,
    View,
)
from tests.helpers.gaussians import NEAR_INFRARED

CELSIUS = TemperatureRange(10.0, 30.0)


def posed_image(values: Tensor, valid: Tensor | None = None) -> PosedImage:
    height, width = values.shape[:2]
    K = torch.tensor(
        [[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], dtype=torch.float64
    )
    camera = Camera(K, torch.eye(4, dtype=torch.float64), width, height)
    return PosedImage(camera, lambda: Pixels(values, valid))


def small_camera(x: float = 0.0) -> Camera:
    """A camera of 8×6 pixels that looks along z, moved by x."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -x
    K = torch.tensor([[9.0, 0, 4.0], [0, 9.0, 3.0], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, viewmat, 8, 6)


def ramp_view(
    name: str = "eval_0",
    rgb: bool = True,
    thermal: bool = True,
    valid: Tensor | None = None,
    nir: bool = False,
) -> View:
    """An RGB image of 24×32 and a thermal image of 18×24, smooth ramps with a warm square; if
    asked for, also a near infrared one of 20×16."""
    ramp = torch.linspace(0.1, 0.6, 32).expand(24, 32)
    color = torch.stack([ramp, 0.9 - ramp, ramp.square()], dim=-1)
    heat = torch.linspace(0.2, 0.3, 24).repeat(18, 1)[..., None]
    heat[5:12, 8:16] = 0.8
    images = {}
    if rgb:
        images[RGB] = posed_image(color)
    if thermal:
        images[THERMAL] = posed_image(heat, valid)
    if nir:
        images[NEAR_INFRARED] = posed_image(torch.linspace(0.1, 0.8, 16).repeat(20, 1)[..., None])
    return View(name, images)


ERRORS = {RGB: 0.1, THERMAL: 0.05, NEAR_INFRARED: 0.01}
"""How much too bright the images are, and how much too high the temperatures: 1 °C of
`CELSIUS`."""


def rendering_of(images: Mapping[Modality, Tensor]) -> Rendering:
    """Images without depth and alpha."""
    return Rendering({modality: Blend.of_image(image) for modality, image in images.items()})


def render_with_error(view: View) -> Rendering:
    """Images that are off by `ERRORS`, at a depth of 2 and with an alpha of 1."""
    images = {each: image.load().values + ERRORS[each] for each, image in view.images.items()}
    return Rendering(
        {
            modality: Blend(image, torch.full(image.shape[:2], 2.0), torch.ones(image.shape[:2]))
            for modality, image in images.items()
        }
    )


class CountingImage:
    """A float image of 4×5×1 (80 bytes), with a mask of 20 bytes if asked for, which counts how
    often it is read."""

    def __init__(self, masked: bool = False) -> None:
        self.reads = 0
        self._valid = torch.ones(4, 5, dtype=torch.bool) if masked else None
        camera = Camera(torch.eye(3, dtype=torch.float64), torch.eye(4, dtype=torch.float64), 5, 4)
        self.posed = PosedImage(camera, self._read)

    def _read(self) -> Pixels:
        self.reads += 1
        return Pixels(torch.full((4, 5, 1), 0.5), self._valid)


def not_rendered(cameras: Mapping[Modality, Camera]) -> Rendering:
    """``LossContext.render`` where no term asks for it."""
    raise AssertionError(f"rendered from {len(cameras)} more cameras")
