"""An orthographic map: temperatures, colours, their support by photos; and the scene from above."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float32, Float64

from mrgs.errors import ConfigError, RunError
from mrgs.maps import surfaces
from mrgs.maps.crs import CoordinateSystem
from mrgs.maps.options import MapOptions
from mrgs.maps.surfaces import Coverage, MapGrid, PhotoStatistics, ShownPlaces
from mrgs.pictures.files import to_array
from mrgs.runs.baked import BakedModel
from mrgs.scene import RGB, THERMAL, Camera, Scene
from mrgs.scene.depth_map import DepthMap

MAX_PIXELS = 50_000_000
"""Largest number of pixels of a map; drawing takes about 60 bytes per pixel."""

PART_PX = 1024
"""Largest width and height, in pixels, of the parts that a map is drawn in."""

LEAST_ALPHA = 0.05
"""A colour that is blended less is darker than its surface."""

Appraise: TypeAlias = Callable[
    [Float32[np.ndarray, "n 3"], Float32[np.ndarray, " n"]],
    tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, " n"]],
]
"""Corrects temperatures, °C, that the cameras of the photos see at points on surfaces, for marked
surfaces with an emissivity of their own; returns also their uncertainty, NaN where not known."""

BANDS = {
    "temperature_c": "°C",
    "red": "0 to 255",
    "green": "0 to 255",
    "blue": "0 to 255",
    "photos": "thermal photos that show the place",
    "scatter_c": "°C, standard deviation of the photos' readings",
    "uncertainty_c": "°C, half of the interval that holds the truth in 95 of 100 cases; without "
    "the thermal camera's own error where its accuracy is not known",
}
"""Names of the bands, and their units."""


@dataclass(frozen=True, eq=False)
class OrthographicMap:
    """A map: its pixels, its ``BANDS``, [7, H, W], and the points of the scene that it shows,
    [H, W, 3]; NaN where there is no surface, temperatures also where no photo looked, the scatter
    where fewer than two did."""

    grid: MapGrid
    bands: Float32[np.ndarray, "b h w"]
    points: Float32[np.ndarray, "h w 3"]

    @property
    def celsius(self) -> Float32[np.ndarray, "h w"]:
        """Temperatures, °C."""
        return self.bands[0]


def draw_map(
    baked: BakedModel,
    scene: Scene,
    maps: Sequence[DepthMap],
    grid: MapGrid,
    appraise: Appraise | None = None,
    coverage: Coverage | None = None,
) -> OrthographicMap:
    """Draw the splats without floaters, seen from very far away.

    The drawing gives the surface of each pixel and its colour. Its temperature is the mean of what
    the cameras of the photos see there in the model, as in all exports: from where no photo was
    taken, splats may leave gaps. ``maps`` are the model's ``survey``; without ``appraise``,
    temperatures are as the photos have them, without uncertainty; ``coverage`` leaves empty what
    too few photos show.

    ConfigError if the map has more than ``MAX_PIXELS``, RunError if no photo shows anything of
    it."""
    if grid.width * grid.height > MAX_PIXELS:
        raise ConfigError(
            f"the map would have {grid.width}×{grid.height} pixels of {grid.pixel_m:g} m, more "
            f"than {MAX_PIXELS:,}; choose larger pixels",
            options=("pixel_size_m",),
        )
    means = to_array(baked.means)
    drawn = torch.from_numpy(
        grid.inside(means.astype(np.float64)) & surfaces.on_seen_surface(maps, means)
    )
    # All others become transparent: a copy of the splats to draw would take more memory.
    opacities = {each: opacity * drawn for each, opacity in baked.opacities.items()}
    splats = replace(baked, opacities=opacities)
    bands = np.full((len(BANDS), grid.height, grid.width), np.nan, np.float32)
    points = np.full((grid.height, grid.width, 3), np.nan, np.float32)
    shown = ShownPlaces(maps, grid)
    for top, left in product(range(0, grid.height, PART_PX), range(0, grid.width, PART_PX)):
        height, width = min(PART_PX, grid.height - top), min(PART_PX, grid.width - left)
        part = slice(top, top + height), slice(left, left + width)
        camera = grid.camera(left, top, width, height)
        bands[1:4, part[0], part[1]], points[part] = _draw_part(splats, scene, camera, part, shown)
    if coverage is not None:
        beyond = ~coverage.covers(*grid.middles)
        bands[:, beyond], points[beyond] = np.nan, np.nan
    statistics = PhotoStatistics(points, grid)
    for image in scene.train_photos(THERMAL):
        statistics.add(surfaces.photo_map(baked, scene, image))
    if not statistics.photos.any():
        raise RunError("no thermal photo shows a surface of this map: check its plane")
    bands[0], bands[5] = statistics.celsius, statistics.scatter_c
    bands[4] = np.where(np.isfinite(points[..., 0]), statistics.photos, np.nan)
    if appraise is not None:
        known = np.isfinite(bands[0])
        bands[0][known], bands[6][known] = appraise(points[known], bands[0][known])
    return OrthographicMap(grid, bands, points)


def _draw_part(
    splats: BakedModel, scene: Scene, camera: Camera, part: tuple[slice, slice], shown: ShownPlaces
) -> tuple[Float32[np.ndarray, "3 h w"], Float32[np.ndarray, "h w 3"]]:
    """Colours, 0 to 255, and points of the surface; NaN where there is none."""
    size = camera.height, camera.width
    colors, points = (np.full(shape, np.nan, np.float32) for shape in ((3, *size), (*size, 3)))
    # The mean would lose digits from as far away as a map's camera stands.
    depth = to_array(splats.median_depth(scene.modalities[0], camera))
    depth = shown.depth_of_part(part, camera, depth)
    surface = np.isfinite(depth)
    points[surface] = surfaces.unprojected(camera, depth)[surface]
    if RGB in scene.modalities:
        blend = splats.render({RGB: camera})[RGB]
        # The light that gets through gaps between splats is black: it is no colour of a surface.
        opaque = blend.image / blend.alpha.clamp_min(LEAST_ALPHA)[..., None]
        colors[:, surface] = 255 * to_array(opaque).clip(0, 1)[surface].T
    return colors, points


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
    axes, scale, offset = _plan_view(system, surfaces.vertical(scene))
    maps = surfaces.survey(baked, scene)
    limit = TIMES_MEDIAN * surfaces.median_distance(maps)
    near = [replace(item, depth=np.where(item.depth < limit, item.depth, np.inf)) for item in maps]
    points = [item.points() for item in near]
    places = [scale * each @ axes[:2].T + offset for each in points]
    coverage = Coverage.of(places, CELL_PX * scale * surfaces.survey_pixel(maps))
    heights = np.concatenate([each @ axes[2] for each in points])
    slab = float(heights.min()), float(heights.max())
    low, high = coverage.bounds
    pixel_m = surfaces.pixel_size_m(scene, maps, options, high - low, most_px)
    # The edges are multiples of the pixel size, as GIS expect of neighbouring maps.
    first, last = np.floor(low / pixel_m).astype(int), np.ceil(high / pixel_m).astype(int)
    width, height = (max(int(size), 1) for size in last - first)
    left, top = float(first[0] * pixel_m), float(last[1] * pixel_m)
    grid = MapGrid(axes, scale, offset, left, top, pixel_m, width, height, slab)
    return draw_map(baked, scene, maps, grid, appraise, coverage)


def _plan_view(
    system: CoordinateSystem, up: Float64[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, "3 3"], float, Float64[np.ndarray, "2"]]:
    """Axes, scale and offset of map coordinates: the CRS's, or of the scene's own frame."""
    if system.on_earth:
        matrix = system.matrix[:3, :3] / system.scale
        axes = np.stack([matrix[0], matrix[1], up])
        return axes, system.scale, system.matrix[:2, 3]
    x = np.eye(3)[0] if abs(up[0]) < 0.9 else np.eye(3)[1]
    right = x - up * (up @ x)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up]), 1.0, np.zeros(2)
