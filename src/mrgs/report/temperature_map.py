"""The temperatures of a façade, a roof or a plant as a map to scale, with the marks on it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from PIL import Image

from mrgs.errors import ConfigError, RunError
from mrgs.export.crs import coordinate_system
from mrgs.export.elevation import facade_map
from mrgs.export.maps.draw import OrthographicMap
from mrgs.export.maps.options import MapOptions
from mrgs.export.maps.picture import frame_map, map_body, map_scale
from mrgs.export.ortho import map_from_above
from mrgs.marks.mark import Mark
from mrgs.marks.regions import Regions
from mrgs.pictures.drawing import Box
from mrgs.report.overlays import draw_name, draw_outline, draw_ring
from mrgs.report.plan import faces_one_side
from mrgs.runs.baked import BakedModel, bake
from mrgs.runs.open import Run
from mrgs.scene import Scene

MOST_PX = 1200
"""Longer side of the map."""

LOOKS_DOWN = 0.7
"""Mean share of the cameras' directions that points down, above which a scene is seen from
above."""


class TemperatureMap(NamedTuple):
    """A map.

    Attributes:
        picture: with marks, legend and scale bar.
        width_m: of the map.
        height_m: of the map.
        pixel_m: side of its pixels.
        from_the_front: whether it shows a façade; else the scene from above.
        north: whether north is up.
    """

    picture: Image.Image
    width_m: float
    height_m: float
    pixel_m: float
    from_the_front: bool
    north: bool


def temperature_map(
    run: Run, scene: Scene, regions: Regions, marks: Mapping[str, Mark]
) -> TemperatureMap | None:
    """The map of a scene that has °C and metres, and is a façade or seen from above; None for all
    others.

    Args:
        run: with the model.
        scene: that it was trained on.
        regions: surfaces with an emissivity of their own, which the map shows corrected.
        marks: by name; those off the map are not drawn.

    Raises:
        SceneError: a photo cannot be read.
    """
    if scene.temperature is None or not scene.world.metric:
        return None
    if not (faces_one_side(scene) or _is_seen_from_above(scene)):
        return None
    baked = regions.of_splats(bake(run.model, scene.train_cameras, run.temperature))
    try:
        return draw_temperature_map(baked, scene, marks)
    except (ConfigError, RunError):
        return None


def draw_temperature_map(
    baked: BakedModel, scene: Scene, marks: Mapping[str, Mark]
) -> TemperatureMap:
    """The map of a façade, or of a scene from above.

    Raises:
        ConfigError: which way is up is not known, or pyproj is not installed.
        RunError: there is no façade.
        SceneError: a photo cannot be read.
    """
    front, north = faces_one_side(scene), False
    if front:
        drawn, _ = facade_map(baked, scene, MapOptions(), most_px=MOST_PX)
    else:
        system = coordinate_system(scene)
        drawn, north = (
            map_from_above(baked, scene, system, MapOptions(), most_px=MOST_PX),
            system.north,
        )
    grid = drawn.grid
    size = grid.width * grid.pixel_m, grid.height * grid.pixel_m
    return TemperatureMap(_picture(drawn, marks, north), *size, grid.pixel_m, front, north)


def _is_seen_from_above(scene: Scene) -> bool:
    down = [-camera.forward[2].item() for camera in scene.train_cameras]
    return sum(down) / len(down) > LOOKS_DOWN


def _picture(drawn: OrthographicMap, marks: Mapping[str, Mark], north: bool) -> Image.Image:
    scale = map_scale(drawn, "inferno")
    body, metres_per_px = map_body(drawn, scale)
    taken: list[Box] = []
    corners = {name: _corners(drawn, mark, metres_per_px) for name, mark in marks.items()}
    shown = {name: each for name, each in corners.items() if _lies_on(body, each)}
    for name, each in shown.items():
        if marks[name].kind == "spot":
            draw_ring(body, *each[0])
        else:
            closed = np.vstack([each, each[:1]]) if marks[name].is_area else each
            draw_outline(body, [*map(tuple, closed)])
    for name, each in shown.items():
        taken.append(
            draw_name(body, float(each[:, 0].mean()), float(each[:, 1].mean()), name, taken)
        )
    return frame_map(body, metres_per_px, scale, north)


def _corners(
    drawn: OrthographicMap, mark: Mark, metres_per_px: float
) -> Float64[np.ndarray, "n 2"]:
    """Pixels of a mark in the map's image; NaN for what is too far before or behind its plane."""
    points = np.array(mark.points, dtype=np.float64)
    corners = (drawn.grid.to_map(points) - (drawn.grid.left, drawn.grid.top)) * (1, -1)
    corners[~drawn.grid.inside(points)] = np.nan
    return corners / metres_per_px


def _lies_on(body: Image.Image, corners: Float64[np.ndarray, "n 2"]) -> bool:
    return bool(((corners >= 0) & (corners <= body.size)).all())
