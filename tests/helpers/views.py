"""Views and renderings whose pixels are known."""

from __future__ import annotations

import torch
from torch import Tensor

from mrgs.render import Rendering
from mrgs.scene import Camera, Pixels, PosedImage, TemperatureRange, View

CELSIUS = TemperatureRange(10.0, 30.0)


def posed_image(values: Tensor, valid: Tensor | None = None) -> PosedImage:
    height, width = values.shape[:2]
    K = torch.tensor(
        [[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], dtype=torch.float64
    )
    camera = Camera(K, torch.eye(4, dtype=torch.float64), width, height)
    return PosedImage(camera, lambda: Pixels(values, valid))


def ramp_view(
    name: str = "eval_0", rgb: bool = True, thermal: bool = True, valid: Tensor | None = None
) -> View:
    """An RGB image of 24×32 and a thermal image of 18×24, smooth ramps with a warm square."""
    ramp = torch.linspace(0.1, 0.6, 32).expand(24, 32)
    color = torch.stack([ramp, 0.9 - ramp, ramp.square()], dim=-1)
    heat = torch.linspace(0.2, 0.3, 24).repeat(18, 1)[..., None]
    heat[5:12, 8:16] = 0.8
    return View(
        name,
        posed_image(color) if rgb else None,
        posed_image(heat, valid) if thermal else None,
    )


def render_with_error(view: View) -> Rendering:
    """Colours 0.1 too bright, temperatures 0.05 (1 °C of `CELSIUS`) too high, at a depth of 2."""
    rgb = view.rgb.load().values + 0.1 if view.rgb else None
    thermal = view.thermal.load().values + 0.05 if view.thermal else None
    depths = [
        None if image is None else torch.full(image.shape[:2], 2.0) for image in (rgb, thermal)
    ]
    return Rendering(rgb, depths[0], thermal, depths[1])


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
