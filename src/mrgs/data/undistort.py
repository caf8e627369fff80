"""Images on coarser grids, and their values between pixels."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import map_coordinates
from torch import Tensor
from torch.nn import functional


def resize(
    values: Float32[Tensor, "h w c"], valid: Bool[Tensor, "h w"] | None, width: int, height: int
) -> tuple[Float32[Tensor, "y x c"], Bool[Tensor, "y x"] | None]:
    """The image on a coarser grid of the same field of view, low-pass filtered (a triangle of two
    output pixels); valid where every pixel that is averaged is."""
    if values.shape[:2] == (height, width):
        return values, valid
    reduced = _reduce(values.movedim(-1, 0), width, height).movedim(0, -1).contiguous()
    if valid is None:
        return reduced, None
    return reduced, _reduce(valid[None].float(), width, height)[0] > 0.999


def reduced(
    values: Float32[Tensor, "h w c"], valid: Bool[Tensor, "h w"] | None, width: int
) -> tuple[Float32[Tensor, "y x c"], Bool[Tensor, "y x"] | None]:
    """An image and its mask, at most ``width`` pixels wide."""
    height, full_width = values.shape[:2]
    if full_width <= width:
        return values.contiguous(), valid
    return resize(values.contiguous(), valid, width, max(1, round(height * width / full_width)))


def sampled(
    values: Float[np.ndarray, "h w"],
    u: Float[np.ndarray, "*n"],
    v: Float[np.ndarray, "*n"],
    step: float = 1.0,
) -> Float[np.ndarray, "*n"]:
    """Bilinear interpolation at pixel positions (u, v) of values that are ``step`` pixels apart;
    the value at the border beyond it."""
    return map_coordinates(values, [v / step - 0.5, u / step - 0.5], order=1, mode="nearest")


def _reduce(planes: Float32[Tensor, "c h w"], width: int, height: int) -> Float32[Tensor, "c y x"]:
    return functional.interpolate(planes[None], (height, width), mode="bilinear", antialias=True)[0]
