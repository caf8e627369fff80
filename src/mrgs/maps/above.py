"""The map of a scene from above."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from mrgs.maps.crs import CoordinateSystem
from mrgs.maps.draw import Appraise, OrthographicMap, draw_map
from mrgs.maps.options import MapOptions
from mrgs.maps.surfaces import (
    Coverage,
    MapGrid,
    median_distance,
    pixel_size_m,
    survey,
    survey_pixel,
    vertical,
)
from mrgs.runs.baked import BakedModel
from mrgs.scene import Scene

TIMES_MEDIAN = 2.5
"""The map shows surfaces within this multiple of the photos' median distance: pixels of what is
farther are too coarse."""

CELL_PX = 4
"""Side of the cells in which photos are counted, in pixels of the survey at the median distance."""


def map_from_above(
    baked: BakedModel,
    scene: Scene,
    system: CoordinateSystem,
    options: MapOptions,
    appraise: Appraise | None = None,
    most_px: int | None = None,
) -> OrthographicMap:
    """The map of a scene from above, in the coordinates of ``system``; for the others see
    ``facade_map``. ConfigError if the vertical is not known or the map has too many pixels,
    RunError if the photos show no surface, SceneError if a photo cannot be read."""
    axes, scale, offset = _plan_view(system, vertical(scene))
    maps = survey(baked, scene)
    limit = TIMES_MEDIAN * median_distance(maps)
    near = [replace(item, depth=np.where(item.depth < limit, item.depth, np.inf)) for item in maps]
    points = [item.points() for item in near]
    places = [scale * each @ axes[:2].T + offset for each in points]
    coverage = Coverage.of(places, CELL_PX * scale * survey_pixel(maps))
    heights = np.concatenate([each @ axes[2] for each in points])
    slab = float(heights.min()), float(heights.max())
    low, high = coverage.bounds
    pixel_m = pixel_size_m(scene, maps, options, high - low, most_px)
    # The edges are multiples of the pixel size, as GIS expect of neighbouring maps.
    first, last = np.floor(low / pixel_m).astype(int), np.ceil(high / pixel_m).astype(int)
    width, height = (max(int(size), 1) for size in last - first)
    left, top = float(first[0] * pixel_m), float(last[1] * pixel_m)
    grid = MapGrid(axes, scale, offset, left, top, pixel_m, width, height, slab)
    return draw_map(baked, scene, maps, grid, appraise, coverage)


def _plan_view(
    system: CoordinateSystem, up: Float64[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, "3 3"], float, Float64[np.ndarray, "2"]]:
    """Axes, scale and offset of map coordinates: those of the CRS, or of the scene's own frame with
    x to the right."""
    if system.on_earth:
        matrix = system.matrix[:3, :3] / system.scale
        axes = np.stack([matrix[0], matrix[1], up])
        return axes, system.scale, system.matrix[:2, 3]
    x = np.eye(3)[0] if abs(up[0]) < 0.9 else np.eye(3)[1]
    right = x - up * (up @ x)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up]), 1.0, np.zeros(2)
