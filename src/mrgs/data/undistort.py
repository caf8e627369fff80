"""From the image a lens made to the image a pinhole camera would have made."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from torch import Tensor
from torch.nn import functional

from mrgs.data.lens import Lens

_EDGE_SAMPLES = 128
_BORDER_TOLERANCE_PX = 0.02
_ROWS_AT_ONCE = 256
_MIN_KEPT = 0.25
"""The pinhole image spans at least this share of the lens's image, undistorted, each way."""


@lru_cache(maxsize=1024)
def pinhole_of(lens: Lens) -> Lens:
    """The pinhole camera for a lens: the same number of pixels over the largest simple rectangle of
    rays that the lens sees, which touches the undistorted image's edges from inside; only corners
    may be invalid. The intrinsics follow from it, and differ a little from the lens's own, unless
    that has no distortion. ValueError if the distortion leaves hardly anything of the image."""
    if lens.is_pinhole:
        return lens
    along_x = np.linspace(0.5, lens.width - 0.5, _EDGE_SAMPLES)
    along_y = np.linspace(0.5, lens.height - 0.5, _EDGE_SAMPLES)
    left, _ = _rays(lens, np.full_like(along_y, 0.5), along_y)
    right, _ = _rays(lens, np.full_like(along_y, lens.width - 0.5), along_y)
    _, top = _rays(lens, along_x, np.full_like(along_x, 0.5))
    _, bottom = _rays(lens, along_x, np.full_like(along_x, lens.height - 0.5))
    fx, cx = _spread(left.max(), right.min(), lens.width, lens.fx)
    fy, cy = _spread(top.max(), bottom.min(), lens.height, lens.fy)
    return Lens(lens.width, lens.height, fx, fy, cx, cy)


def undistort(
    values: Float32[Tensor, "h w c"], valid: Bool[Tensor, "h w"] | None, lens: Lens
) -> tuple[Float32[Tensor, "h w c"], Bool[Tensor, "h w"] | None]:
    """The image of ``pinhole_of(lens)``, sampled bilinearly, with the mask of its usable pixels
    (None if all)."""
    if lens.is_pinhole:
        return values, valid
    grid, seen = _sampling_grid(lens)
    warped = _sample(values.movedim(-1, 0), grid).movedim(0, -1)
    if valid is not None:
        seen = seen & (_sample(valid[None].float(), grid)[0] > 0.999)
    return warped.contiguous(), None if seen.all() else seen


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


def _rays(
    lens: Lens, u: NDArray[np.float64], v: NDArray[np.float64]
) -> tuple[NDArray[np.float64], ...]:
    """Normalised coordinates of the rays that reach the pixel positions (u, v)."""
    return lens.undistort((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy)


def _spread(low: float, high: float, pixels: int, focal_px: float) -> tuple[float, float]:
    """Focal length and principal point with the outer pixels' centres at ``low`` and ``high``."""
    steps = max(pixels - 1, 1)
    if not (high - low) * focal_px >= _MIN_KEPT * steps:
        raise ValueError(
            "the distortion coefficients fold the image, so that hardly anything of it would be "
            "left"
        )
    focal = steps / (high - low)
    return float(focal), float(0.5 - focal * low)


@lru_cache(maxsize=2)
def _sampling_grid(lens: Lens) -> tuple[Float32[Tensor, "h w 2"], Bool[Tensor, "h w"]]:
    """Where each pixel of the pinhole image is in the lens's image ([-1, 1] from edge to edge), and
    if it is there; cached for the two cameras of a rig."""
    pinhole = pinhole_of(lens)
    grid = np.empty((lens.height, lens.width, 2), dtype=np.float32)
    seen = np.empty((lens.height, lens.width), dtype=bool)
    x = (np.arange(lens.width) + 0.5 - pinhole.cx) / pinhole.fx
    for first in range(0, lens.height, _ROWS_AT_ONCE):
        rows = slice(first, min(first + _ROWS_AT_ONCE, lens.height))
        y = (np.arange(rows.start, rows.stop) + 0.5 - pinhole.cy) / pinhole.fy
        block_x, block_y = np.meshgrid(x, y)
        distorted_x, distorted_y = lens.distort(block_x, block_y)
        u, v = lens.fx * distorted_x + lens.cx, lens.fy * distorted_y + lens.cy
        margin = 0.5 - _BORDER_TOLERANCE_PX
        inside = (
            (u >= margin) & (u <= lens.width - margin) & (v >= margin) & (v <= lens.height - margin)
        )
        seen[rows] = inside & lens.before_fold(block_x, block_y)
        grid[rows, :, 0] = np.clip(2 * u / lens.width - 1, -2, 2)
        grid[rows, :, 1] = np.clip(2 * v / lens.height - 1, -2, 2)
    return torch.from_numpy(grid), torch.from_numpy(seen)


def _sample(
    planes: Float32[Tensor, "c h w"], grid: Float32[Tensor, "h w 2"]
) -> Float32[Tensor, "c h w"]:
    return functional.grid_sample(
        planes[None], grid[None], padding_mode="border", align_corners=False
    )[0]


def _reduce(planes: Float32[Tensor, "c h w"], width: int, height: int) -> Float32[Tensor, "c y x"]:
    return functional.interpolate(planes[None], (height, width), mode="bilinear", antialias=True)[0]
