"""Where in a map there is a surface, by what the photos show."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float32, Float64

from mrgs.export.maps.grid import MapGrid, unprojected
from mrgs.export.maps.photos import survey_pixel
from mrgs.scene import Camera
from mrgs.scene.depth_map import DepthMap

CELL = 1.5
"""Side of the cells in which the surfaces of several photos are put together, in their pixels."""

LEAST_POINTS = 3
"""Fewer of them in a cell are no surface."""


class ShownPlaces:
    """The surfaces in the pixels of a map.

    From far away, where no photo was taken, a model also shows what floats before its surfaces, and
    what lies behind gaps between its splats. In no photo it does.

    Args:
        maps: what the photos show, see ``survey``.
        grid: the pixels.
    """

    def __init__(self, maps: Sequence[DepthMap], grid: MapGrid) -> None:
        self._grid = grid
        self._maps = [(item, grid.window_of(item.points())) for item in maps]
        self._cell_px = max(math.ceil(CELL * survey_pixel(maps) * grid.scale / grid.pixel_m), 1)

    def depth_of_part(
        self, part: tuple[slice, slice], camera: Camera, depth: Float32[np.ndarray, "h w"]
    ) -> Float32[np.ndarray, "h w"]:
        """The depth in a part of the map where a photo shows that surface; elsewhere that of the
        photos' own surfaces, NaN where they have none, [H, W].

        Args:
            part: rows and columns in the map.
            camera: of the part.
            depth: that it sees; NaN where there is none.
        """
        points = unprojected(camera, depth).astype(np.float32)
        near = [each for each in self._maps if _overlap(each[1], part)]
        found = np.zeros(depth.shape, bool)
        for item, window in near:
            there = tuple(map(_within, window, part))
            unknown = np.isfinite(points[there][..., 0]) & ~found[there]
            places = np.flatnonzero(unknown)
            rows = item.shown(points[there][unknown]).rows
            found[there][np.unravel_index(places[rows], unknown.shape)] = True
        others = [item.points() for item, _ in near] if not found.all() else []
        seen = np.concatenate([np.empty((0, 3)), *others])
        seen = seen[self._grid.inside(seen)]
        return np.where(found, depth, _depth_of_cells(camera, seen, self._cell_px))


def _overlap(window: tuple[slice, slice], part: tuple[slice, slice]) -> bool:
    return all(a.start < b.stop and b.start < a.stop for a, b in zip(window, part, strict=True))


def _within(span: slice, part: slice) -> slice:
    """The indices of a span that lie in a part, counted from the part's first."""
    low, high = (min(max(end, part.start), part.stop) for end in (span.start, span.stop))
    return slice(low - part.start, high - part.start)


def _depth_of_cells(
    camera: Camera, points: Float64[np.ndarray, "n 3"], cell_px: int
) -> Float32[np.ndarray, "h w"]:
    """The median depth of the points in square cells of an image, in all of their pixels; NaN in
    cells with fewer than ``LEAST_POINTS``."""
    pixels, z = camera.project(torch.from_numpy(points))
    inside = camera.contains(pixels)
    columns, rows = (pixels[inside] / cell_px).long().unbind(dim=1)
    across, down = (-(-size // cell_px) for size in (camera.width, camera.height))
    cells, depths = (rows * across + columns).numpy(), z[inside].numpy()
    order = np.lexsort([depths, cells])
    taken, first, count = np.unique(cells[order], return_index=True, return_counts=True)
    many = count >= LEAST_POINTS
    found = np.full(across * down, np.nan, np.float32)
    found[taken[many]] = depths[order][(first + count // 2)[many]]
    whole = found.reshape(down, across).repeat(cell_px, axis=0).repeat(cell_px, axis=1)
    return whole[: camera.height, : camera.width]
