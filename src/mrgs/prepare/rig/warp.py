"""The photo warped to the thermal camera by the depth of its surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import gaussian_filter

from mrgs.data.lens import Lens
from mrgs.data.undistort import sampled
from mrgs.prepare.rig.depth import STEP_PX
from mrgs.prepare.rig.images import ReducedPair

_ITERATIONS = 6


@dataclass(frozen=True, eq=False)
class Warped:
    """A photo on the thermal camera's pixel grid.

    Attributes:
        values: the photo's luma.
        points: surface point of each pixel [H, W, 3], in the axes of the photo's camera.
        seen: whether the photo shows it.
    """

    values: Float32[np.ndarray, "h w"]
    points: Float[np.ndarray, "h w 3"]
    seen: Bool[np.ndarray, "h w"]


def thermal_rays(lens: Lens, width: int, height: int) -> Float[np.ndarray, "h w 3"]:
    """The ray (x, y, 1) of each pixel of the thermal image, when it is resized to width ×
    height."""
    u, v = np.meshgrid(
        (np.arange(width) + 0.5) * lens.width / width,
        (np.arange(height) + 0.5) * lens.height / height,
    )
    x, y = lens.undistort((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def warp(
    pair: ReducedPair,
    rays: Float[np.ndarray, "h w 3"],
    photo_from_thermal: Float[np.ndarray, "4 4"],
    spacing: float,
) -> Warped:
    """The photo warped to the thermal camera's grid.

    The intersection of each ray with the photo's surfaces is found by fixed-point iteration: the
    point of the ray at the current depth, and the photo's depth at its projection.

    Args:
        pair: the photo with its depth.
        rays: of the thermal pixels, from ``thermal_rays``.
        photo_from_thermal: rigid motion [4, 4] from the thermal camera's axes to the photo's.
        spacing: of the thermal pixels, in photo pixels; the photo is blurred accordingly.
    """
    directions = np.einsum("ij,hwj->hwi", photo_from_thermal[:3, :3], rays)
    centre = photo_from_thermal[:3, 3]
    fx, fy, cx, cy = pair.camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    inverse: Float[np.ndarray, "h w"] = np.full(rays.shape[:2], pair.depth.median)
    ahead = directions[..., 2] > 0.1
    depth_along = np.where(ahead, directions[..., 2], 1.0)
    for _ in range(_ITERATIONS):
        along = (1 / np.maximum(inverse, 1e-9) - centre[2]) / depth_along
        points = centre + along[..., None] * directions
        u, v = fx * points[..., 0] / points[..., 2] + cx, fy * points[..., 1] / points[..., 2] + cy
        inverse = sampled(pair.depth.values, u, v, STEP_PX)
    seen = (
        ahead
        & (along > 0)
        & (u > 1)
        & (u < pair.camera.width - 1)
        & (v > 1)
        & (v < pair.camera.height - 1)
    )
    if pair.photo.valid is not None:
        seen &= sampled(pair.photo.valid.astype(np.float32), u, v) > 0.99
    photo = pair.photo.values
    if spacing > 1:
        photo = gaussian_filter(photo, 0.5 * np.sqrt(spacing**2 - 1))
    return Warped(sampled(photo, u, v).astype(np.float32), points, seen)
