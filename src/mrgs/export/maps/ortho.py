"""``ortho.tif``: the scene from above in °C, as a GeoTIFF, and as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from mrgs.export.crs import CoordinateSystem, coordinate_system
from mrgs.export.job import ExportJob
from mrgs.export.maps.draw import OrthographicMap, draw_map
from mrgs.export.maps.options import MapOptions
from mrgs.export.maps.picture import Caption
from mrgs.export.maps.surfaces import Coverage, MapGrid, median_distance, survey, survey_pixel
from mrgs.export.maps.write import (
    pixel_size_m,
    require_map,
    summary,
    vertical,
    write_map,
)
from mrgs.marks.regions import Regions
from mrgs.marks.uncertainty import UncertaintyMeter
from mrgs.runs.baked import BakedModel
from mrgs.scene import Scene
from mrgs.scene.depth_map import DepthMap

TIMES_MEDIAN = 2.5
"""The map holds the surfaces that photos show from up to so many times the median distance: what is
farther has too coarse pixels."""

CELL_PX = 4
"""Side of the cells in which photos are counted, in pixels of the survey at the median distance."""


def export(job: ExportJob) -> list[Path]:
    """Write ``ortho.tif`` with its sidecar, and ``ortho.png``."""
    system = coordinate_system(job.scene, job.maps.crs)
    drawn = map_from_above(
        job.baked, job.scene, system, job.maps, job.uncertainty, regions=job.regions
    )
    caption, facts = caption_and_facts(job.scene.name, drawn, system)
    return write_map(job, "ortho", drawn, system.wkt, caption, facts)


def caption_and_facts(
    name: str, drawn: OrthographicMap, system: CoordinateSystem
) -> tuple[Caption, dict[str, Any]]:
    """The texts of a map's picture, and the facts of its sidecar."""
    north = " · north is up" if system.north else ""
    caption = Caption(
        f"{name}: temperatures from above",
        f"{system.name}{north} · {drawn.grid.pixel_m * 100:g} cm per pixel",
        summary(drawn),
        system.north_deg,
    )
    facts: dict[str, Any] = {
        "map": "orthographic, from above",
        "map_crs": system.name,
        "map_crs_residual_m": round(system.residual_m, 6),
    }
    if system.north_deg is not None:
        facts["map_north_clockwise_from_up_deg"] = round(system.north_deg, 3)
    return caption, facts


def require(scene: Scene, crs: str | None = None) -> None:
    """Check that a map can be written, see ``require_map``, in a CRS, see ``coordinate_system``."""
    require_map(scene)
    coordinate_system(scene, crs)


def map_from_above(
    baked: BakedModel,
    scene: Scene,
    system: CoordinateSystem,
    options: MapOptions,
    uncertainty: UncertaintyMeter | None = None,
    most_px: int | None = None,
    regions: Regions | None = None,
) -> OrthographicMap:
    """The map of a scene from above.

    Args:
        uncertainty: of the temperatures; None leaves its band empty.
        most_px: for the longer side of the map; None without a limit.
        regions: surfaces with an emissivity of their own, which the map shows corrected.

    Raises:
        ConfigError: which way is up is not known, or the map has too many pixels.
        RunError: the photos show no surface.
        SceneError: a photo cannot be read.
    """
    axes, scale, offset = _plan_view(system, vertical(scene))
    maps = survey(baked, scene)
    points = _near_points(maps)
    places = [scale * each @ axes[:2].T + offset for each in points]
    coverage = Coverage.of(places, CELL_PX * scale * survey_pixel(maps))
    heights = np.concatenate([each @ axes[2] for each in points])
    slab = float(heights.min()), float(heights.max())
    extent = np.subtract(*coverage.bounds[::-1])
    pixel_m = pixel_size_m(scene, maps, options, extent, most_px)
    grid = _grid(coverage, axes, scale, offset, slab, pixel_m)
    return draw_map(baked, scene, maps, grid, uncertainty, coverage, regions)


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


def _near_points(maps: Sequence[DepthMap]) -> list[Float64[np.ndarray, "_ 3"]]:
    """The surfaces that the map may hold, as each photo shows them."""
    limit = TIMES_MEDIAN * median_distance(maps)
    near = [replace(item, depth=np.where(item.depth < limit, item.depth, np.inf)) for item in maps]
    return [item.points() for item in near]


def _grid(
    coverage: Coverage,
    axes: Float64[np.ndarray, "3 3"],
    scale: float,
    offset: Float64[np.ndarray, "2"],
    slab: tuple[float, float],
    pixel_m: float,
) -> MapGrid:
    """The pixels about what enough photos show; their edges are multiples of the pixel size, as GIS
    expect of neighbouring maps."""
    low, high = coverage.bounds
    first, last = np.floor(low / pixel_m).astype(int), np.ceil(high / pixel_m).astype(int)
    width, height = (max(int(size), 1) for size in last - first)
    left, top = float(first[0] * pixel_m), float(last[1] * pixel_m)
    return MapGrid(axes, scale, offset, left, top, pixel_m, width, height, slab)
