"""Lenses: a pinhole with Brown's radial and tangential distortion, or Kannala and Brandt's fisheye.

Normalised coordinates (x, y) are those of the ray (x, y, 1) in the camera; a lens moves them to

    Brown:    x' = s x + 2 p1 x y + p2 (r² + 2 x²),  y' = s y + p1 (r² + 2 y²) + 2 p2 x y,
              s = 1 + Σ k_i r^(2i)
    fisheye:  x' = s x,  y' = s y,  s = θ (1 + Σ k_i θ^(2i)) / r,  θ = atan r

and the pixel is (fx x' + cx, fy y' + cy), as in OpenCV, COLMAP and nerfstudio. The image's corner,
not the centre of its first pixel, is at (0, 0), in COLMAP and nerfstudio as here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mrgs.data.files import MAX_MAGNITUDE, scene_error

Array = NDArray[np.float64]

WIDEST_ANGLE_DEG = 70.0
"""Rays farther from the axis are left out: a pinhole image there is mostly stretched border."""

_FOLD_ANGLES = 256
_FOLD_RADII = 512
_NEWTON_STEPS, _ROUNDING = 40, 1e-15
_MAX_SIDE_PX = 1_000_000
_SHORTEST_PX = 1e-3
"""Shorter focal lengths are damage."""


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

    def resized(self, width: int, height: int) -> Lens:
        """The lens for the same field of view on a pixel grid of this width and height."""
        x, y = width / self.width, height / self.height
        sizes = width, height, self.fx * x, self.fy * y, self.cx * x, self.cy * y
        return Lens(*sizes, self.radial, self.tangential, self.fisheye)

    def distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Normalised coordinates of rays -> distorted normalised coordinates (any shape)."""
        r2 = x * x + y * y
        scale, _ = self._radial_scale(r2)
        p1, p2 = self.tangential
        return (
            scale * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            scale * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )

    def undistort(self, x: Array, y: Array) -> tuple[Array, Array]:
        """The inverse of ``distort`` by Newton's method, with shorter steps where a full one leads
        away. A point that no ray reaches (beyond the polynomial's fold) gives a ray near the
        fold."""
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


def checked_lens(lens: Lens, what: str, file: Path) -> Lens:
    """The lens itself, if its numbers can be those of a camera. SceneError for sizes or focal
    lengths that are not positive, and numbers that are not finite or huge."""
    numbers = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.radial, *lens.tangential)
    if not all(abs(number) <= MAX_MAGNITUDE for number in numbers):
        raise scene_error(
            file, f"the intrinsics of {what} hold NaN, infinity or a huge number; correct them"
        )
    if not (1 <= lens.width <= _MAX_SIDE_PX and 1 <= lens.height <= _MAX_SIDE_PX):
        fault = f"the image size of {what}, {lens.width}×{lens.height}, is not possible; correct it"
        raise scene_error(file, fault)
    if not min(lens.fx, lens.fy) >= _SHORTEST_PX:
        raise scene_error(
            file,
            f"the focal length of {what} is {lens.fx:g}, {lens.fy:g} px; it must be positive: "
            f"correct it",
        )
    return lens


@lru_cache(maxsize=16)
def _fold_table(
    radial: tuple[float, float, float, float], tangential: tuple[float, float], fisheye: bool
) -> tuple[Array, Array]:
    """Directions around the optical axis (radians), and the normalised radius up to which each is
    one-to-one: while the symmetric Jacobian, on the way from the axis, stays positive definite."""
    lens = Lens(1, 1, 1.0, 1.0, 0.0, 0.0, radial, tangential, fisheye)
    angles = np.linspace(-math.pi, math.pi, _FOLD_ANGLES, endpoint=False)
    radii = np.linspace(0.0, math.tan(math.radians(WIDEST_ANGLE_DEG)), _FOLD_RADII)
    with np.errstate(all="ignore"):
        a, b, d = lens._jacobian(radii * np.cos(angles)[:, None], radii * np.sin(angles)[:, None])
        folded = ~((a * d - b * b > 0) & (a + d > 0))
    folded[:, -1] = True
    return angles, radii[np.maximum(folded.argmax(axis=1) - 1, 0)]
