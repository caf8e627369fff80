"""Lenses, a pinhole with Brown's radial and tangential distortion or Kannala and Brandt's fisheye,
and the images that pinholes would have made in their place.

Normalised coordinates (x, y) are those of the ray (x, y, 1) in the camera; a lens moves them to

    Brown:    x' = s x + 2 p1 x y + p2 (r² + 2 x²),  y' = s y + p1 (r² + 2 y²) + 2 p2 x y,
              s = 1 + Σ k_i r^(2i)
    fisheye:  x' = s x,  y' = s y,  s = θ (1 + Σ k_i θ^(2i)) / r,  θ = atan r

and the pixel is (fx x' + cx, fy y' + cy), as in OpenCV, COLMAP and nerfstudio. The image's corner,
not the centre of its first pixel, is at (0, 0), in COLMAP and nerfstudio as here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from mrgs.scene.camera import Camera

Array = NDArray[np.float64]

WIDEST_ANGLE_DEG = 70.0
"""Rays farther off the optical axis are left out: a pinhole image is mostly stretched there."""

_FOLD_ANGLES = 256
_FOLD_RADII = 512
_NEWTON_STEPS, _ROUNDING = 40, 1e-15
_EDGE_SAMPLES = 128
_BORDER_TOLERANCE_PX = 0.02
_ROWS_AT_ONCE = 256
_MIN_KEPT = 0.25
"""Least share of the (undistorted) lens's image that the pinhole's spans in each direction."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics and distortion of an image file; all lengths in pixels. ``radial`` are k1 to k4,
    ``tangential`` p1 and p2, which a fisheye does not use."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)
    fisheye: bool = False

    @property
    def is_pinhole(self) -> bool:
        """Whether the lens has no distortion at all."""
        return not self.fisheye and not any(self.radial) and not any(self.tangential)

    @classmethod
    def of_opencv(cls, camera: Camera, numbers: Sequence[float], fisheye: bool, name: str) -> Lens:
        """The lens of a camera with OpenCV's coefficients: k1, k2, p1, p2 and perhaps k3, or k1 to
        k4 of ``cv2.fisheye``. ValueError, with the ``name``, for another number of them."""
        names = "4 of a fisheye (k1, k2, k3, k4)" if fisheye else "4 or 5 (k1, k2, p1, p2[, k3])"
        if len(numbers) not in ((4,) if fisheye else (4, 5)):
            raise ValueError(f"{name} must have {names}, not {len(numbers)}: calibrate with these")
        K = camera.K.tolist()
        sizes = camera.width, camera.height, K[0][0], K[1][1], K[0][2], K[1][2]
        k1, k2, p1, p2, k3 = (*numbers, 0.0)[:5]
        if fisheye:
            return cls(*sizes, (k1, k2, p1, p2), fisheye=True)
        return cls(*sizes, (k1, k2, k3, 0.0), (p1, p2))

    def resized(self, width: int, height: int) -> Lens:
        """The lens for the same field of view on a pixel grid of this width and height."""
        x, y = width / self.width, height / self.height
        sizes = width, height, self.fx * x, self.fy * y, self.cx * x, self.cy * y
        return Lens(*sizes, self.radial, self.tangential, self.fisheye)

    def distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Normalised coordinates of rays -> distorted normalised coordinates (any shape)."""
        scale, _ = self._radial_scale(x * x + y * y)
        p1, p2 = self.tangential
        r2 = x * x + y * y
        return (
            scale * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            scale * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )

    def undistort(self, x: Array, y: Array) -> tuple[Array, Array]:
        """The inverse of ``distort`` by Newton's method, with shorter steps where a full one leads
        away.

        A point that no ray reaches (beyond the fold of the polynomial) comes back as a ray near the
        fold.
        """
        u, v = self._inside_fold(x, y)
        share = np.ones_like(u)
        with np.errstate(all="ignore"):
            error = np.subtract(self.distort(u, v), (x, y))
            for _ in range(_NEWTON_STEPS):
                a, b, d = self._jacobian(u, v)
                right, down = share / (a * d - b * b) * error
                trial = self._inside_fold(u - (d * right - b * down), v - (a * down - b * right))
                trial_error = np.subtract(self.distort(*trial), (x, y))
                better = np.hypot(*trial_error) < np.hypot(*error)
                share = np.where(better, np.minimum(2 * share, 1.0), share / 2)
                u, v = np.where(better, trial, (u, v))
                error = np.where(better, trial_error, error)
                if np.hypot(*error).max(initial=0) < _ROUNDING:
                    break
        return u, v

    def rays(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Normalised coordinates of the rays that reach the pixel positions (u, v)."""
        return self.undistort((u - self.cx) / self.fx, (v - self.cy) / self.fy)

    def before_fold(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """Whether the distortion is one-to-one from the optical axis out to the ray (x, y, 1)."""
        return np.hypot(x, y) <= self._fold_radius(x, y)

    def _fold_radius(self, x: Array, y: Array) -> Array:
        angles, radii = _fold_table(self.radial, self.tangential, self.fisheye)
        return np.interp(np.arctan2(y, x), angles, radii, period=2 * math.pi)

    def _inside_fold(self, x: Array, y: Array) -> tuple[Array, Array]:
        x, y = np.nan_to_num(x, posinf=1e3, neginf=-1e3), np.nan_to_num(y, posinf=1e3, neginf=-1e3)
        shrink = np.minimum(1.0, self._fold_radius(x, y) / np.maximum(np.hypot(x, y), 1e-12))
        return x * shrink, y * shrink

    def _radial_scale(self, r2: Array) -> tuple[Array, Array]:
        """The scale s and ds/d(r²)."""
        k1, k2, k3, k4 = self.radial
        if not self.fisheye:
            scale = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
            return scale, k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * 4 * k4))
        r2 = np.maximum(r2, 1e-8)  # below, s is 1 to eight digits
        r = np.sqrt(r2)
        theta = np.arctan(r)
        t2 = theta * theta
        bent = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        bent_slope = (1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))) / (1 + r2)
        return bent / r, (bent_slope - bent / r) / (2 * r2)

    def _jacobian(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """∂x'/∂x, ∂x'/∂y = ∂y'/∂x and ∂y'/∂y of ``distort``."""
        scale, slope = self._radial_scale(x * x + y * y)
        p1, p2 = self.tangential
        return (
            scale + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
            2 * x * y * slope + 2 * p1 * x + 2 * p2 * y,
            scale + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
        )


@lru_cache(maxsize=16)
def _fold_table(
    radial: tuple[float, float, float, float], tangential: tuple[float, float], fisheye: bool
) -> tuple[Array, Array]:
    """Directions around the optical axis (radians), and the normalised radius up to which each is
    one-to-one.

    The Jacobian is symmetric; the mapping is one-to-one while it stays positive definite on the way
    from the axis.
    """
    lens = Lens(1, 1, 1.0, 1.0, 0.0, 0.0, radial, tangential, fisheye)
    angles = np.linspace(-math.pi, math.pi, _FOLD_ANGLES, endpoint=False)
    radii = np.linspace(0.0, math.tan(math.radians(WIDEST_ANGLE_DEG)), _FOLD_RADII)
    with np.errstate(all="ignore"):
        a, b, d = lens._jacobian(radii * np.cos(angles)[:, None], radii * np.sin(angles)[:, None])
        folded = ~((a * d - b * b > 0) & (a + d > 0))
    folded[:, -1] = True
    return angles, radii[np.maximum(folded.argmax(axis=1) - 1, 0)]


@lru_cache(maxsize=1024)
def pinhole_of(lens: Lens) -> Lens:
    """The pinhole camera for a lens: the same number of pixels, spread over the largest simple
    rectangle of rays that the lens sees.

    The rectangle touches the undistorted image's four edges from inside, so that every pixel is
    valid, except near corners that the lens cannot see. The four intrinsics follow from it; fx, fy
    and the principal point differ a little from the lens's own. A lens without distortion is
    returned unchanged. ValueError if the distortion is too strong to be true: hardly anything of
    the image would be left.
    """
    if lens.is_pinhole:
        return lens
    along_x = np.linspace(0.5, lens.width - 0.5, _EDGE_SAMPLES)
    along_y = np.linspace(0.5, lens.height - 0.5, _EDGE_SAMPLES)
    left, _ = lens.rays(np.full_like(along_y, 0.5), along_y)
    right, _ = lens.rays(np.full_like(along_y, lens.width - 0.5), along_y)
    _, top = lens.rays(along_x, np.full_like(along_x, 0.5))
    _, bottom = lens.rays(along_x, np.full_like(along_x, lens.height - 0.5))
    fx, cx = _spread(left.max(), right.min(), lens.width, lens.fx)
    fy, cy = _spread(top.max(), bottom.min(), lens.height, lens.fy)
    return Lens(lens.width, lens.height, fx, fy, cx, cy)


@lru_cache(maxsize=1024)
def matrix_of(pinhole: Lens) -> Float64[Tensor, "3 3"]:
    """K of a lens without distortion; cameras share it."""
    return torch.tensor(
        [[pinhole.fx, 0.0, pinhole.cx], [0.0, pinhole.fy, pinhole.cy], [0.0, 0.0, 1.0]],
        dtype=torch.float64,
    )


def undistort(
    values: Float32[Tensor, "h w c"], valid: Bool[Tensor, "h w"] | None, lens: Lens
) -> tuple[Float32[Tensor, "h w c"], Bool[Tensor, "h w"] | None]:
    """The image of ``pinhole_of(lens)``, bilinearly sampled, and its usable pixels (None: all)."""
    if lens.is_pinhole:
        return values, valid
    grid, seen = _sampling_grid(lens)
    warped = _sample(values.movedim(-1, 0), grid).movedim(0, -1)
    if valid is not None:
        seen = seen & (_sample(valid[None].float(), grid)[0] > 0.999)
    return warped.contiguous(), None if seen.all() else seen


def _spread(low: float, high: float, pixels: int, focal_px: float) -> tuple[float, float]:
    """Focal length and principal point that put the first pixel's centre at ``low`` and the last
    one's at ``high``."""
    steps = max(pixels - 1, 1)
    if not (high - low) * focal_px >= _MIN_KEPT * steps:
        raise ValueError(
            "the distortion coefficients fold the image, so that hardly anything would be left"
        )
    focal = steps / (high - low)
    return float(focal), float(0.5 - focal * low)


@lru_cache(maxsize=2)
def _sampling_grid(lens: Lens) -> tuple[Float32[Tensor, "h w 2"], Bool[Tensor, "h w"]]:
    """Where each pixel of the pinhole image is in the lens's image ([-1, 1] from edge to edge),
    and if it does.

    Cached for the two cameras of a rig; a few bytes per pixel each.
    """
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
