"""Depth maps of many cameras into one truncated signed distance field, in a band about the
surfaces.

B. Curless and M. Levoy, "A Volumetric Method for Building Complex Models from Range Images", 1996.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float32, Float64

from mrgs.scene.depth_map import DepthMap, visible

TRUNCATION_VOXELS = 4
"""Half width of the band."""

MIN_VIEWS = 2
"""A sample that fewer cameras saw is not known."""

BOUNDS_PERCENTILE = 2.0
"""The box holds the points between this percentile and its counterpart on each axis: far background
is left out."""


@dataclass(frozen=True, eq=False)
class Grid:
    """A regular grid: sample (i, j, k) lies at ``origin`` + ``step`` · (i, j, k).

    Attributes:
        origin: world coordinates of the first sample, [3].
        step: distance between samples, scene units.
        shape: samples along each axis.
    """

    origin: Float64[np.ndarray, "3"]
    step: float
    shape: tuple[int, int, int]


def fuse(maps: Sequence[DepthMap], resolution: int) -> tuple[Float32[np.ndarray, "x y z"], Grid]:
    """The distance field, in units of the truncation, positive before the surfaces; NaN where it is
    not known.

    Args:
        maps: depth maps of overlapping cameras; at least one depth is known.
        resolution: samples along the longest side of the box about the scene; fewer where the
            pixels are coarser.
    """
    grid = _grid_of(maps, resolution)
    samples = np.argwhere(_band(maps, grid))
    positions = (grid.origin + grid.step * samples).astype(np.float32)
    total, count = np.zeros(len(samples), np.float32), np.zeros(len(samples), np.int32)
    truncation = TRUNCATION_VOXELS * grid.step
    for item in maps:
        rows, pixels, z = visible(item.camera, positions)
        distance = (item.depth[pixels] - z) / truncation
        seen = distance > -1  # false for NaN
        total[rows[seen]] += distance[seen].clip(max=1)
        count[rows[seen]] += 1
    field = np.full(grid.shape, np.nan, dtype=np.float32)
    known = count >= MIN_VIEWS
    field[tuple(samples[known].T)] = total[known] / count[known]
    return field, grid


def _grid_of(maps: Sequence[DepthMap], resolution: int) -> Grid:
    """A box about the seen points, its step no finer than the median width of a pixel on the
    surfaces."""
    points = np.concatenate([item.points() for item in maps])
    low, high = np.percentile(points, [BOUNDS_PERCENTILE, 100 - BOUNDS_PERCENTILE], axis=0)
    surfaces = [(item.depth[np.isfinite(item.depth)], float(item.camera.K[0, 0])) for item in maps]
    pixel = np.median([np.median(depth) / focal for depth, focal in surfaces if len(depth)])
    step = max(float((high - low).max()) / resolution, float(pixel), 1e-6)
    margin = (TRUNCATION_VOXELS + 1) * step
    shape = np.ceil((high - low + 2 * margin) / step).astype(int) + 1
    return Grid(low - margin, step, (int(shape[0]), int(shape[1]), int(shape[2])))


def _band(maps: Sequence[DepthMap], grid: Grid) -> Bool[np.ndarray, "x y z"]:
    """The samples close to a seen surface."""
    band = np.zeros(grid.shape, dtype=bool)
    offsets = tuple(grid.step * k for k in range(-TRUNCATION_VOXELS, TRUNCATION_VOXELS + 1))
    for item in maps:
        for offset in offsets:
            points = item.points(offset)
            nearest = np.rint((points - grid.origin) / grid.step).astype(np.int64)
            nearest = nearest[((nearest >= 0) & (nearest < grid.shape)).all(axis=1)]
            band[tuple(nearest.T)] = True
    return scipy.ndimage.binary_dilation(band)
