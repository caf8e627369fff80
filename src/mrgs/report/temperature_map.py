"""The temperatures of a façade, a roof or a plant as a map to scale, with the marks on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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
from mrgs.report.overlays import draw_marks, draw_place, small_picture
from mrgs.report.plan import faces_one_side
from mrgs.runs.baked import BakedModel, bake
from mrgs.runs.open import Run
from mrgs.scene import Scene

MOST_PX = 1200
"""Longer side of the map."""

SMALL_DRAWN_PX, SMALL_RADIUS = 1200, 0.02
WHITE_SHARE = 0.3
"""In the colours of the small map, so that the mark stands out."""

LOOKS_DOWN = 0.7
"""Mean share of the cameras' directions that points down, above which a scene is seen from
above."""


@dataclass(frozen=True, eq=False)
class TemperatureMap:
    """A map for a report.

    Attributes:
        drawn: the map.
        from_the_front: whether it shows a façade; else the scene from above.
        north: whether north is up.
    """

    drawn: OrthographicMap
    from_the_front: bool
    north: bool

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height, metres."""
        grid = self.drawn.grid
        return grid.width * grid.pixel_m, grid.height * grid.pixel_m

    def shows(self, mark: Mark) -> bool:
        """Whether all of a mark lies on the map."""
        corners, size = self._pixels(mark), self.drawn.celsius.shape[::-1]
        return bool(((corners >= 0) & (corners <= size)).all())

    def picture(self, marks: Mapping[str, Mark], decimal: str = ".") -> Image.Image:
        """The temperatures with legend and scale bar, and the marks that lie on the map under
        their names; ``decimal`` is written before the decimals of the legend's numbers."""
        scale = map_scale(self.drawn, "inferno")._replace(decimal=decimal)
        body, metres_per_px = map_body(self.drawn, scale)
        zoom = self.drawn.grid.pixel_m / metres_per_px
        shown = {
            name: zoom * self._pixels(each) for name, each in marks.items() if self.shows(each)
        }
        draw_marks(body, marks, shown)
        return frame_map(body, metres_per_px, scale, 0.0 if self.north else None)

    def small(self, mark: Mark) -> Image.Image:
        """Where a mark is that lies on the map: in the colours of the photos, where there are
        any."""
        colors = self.drawn.bands[1:4].transpose(1, 2, 0)
        if np.isnan(colors).all():
            image, metres_per_px = map_body(self.drawn, map_scale(self.drawn, "grey"))
        else:
            pale = np.nan_to_num(WHITE_SHARE * 255 + (1 - WHITE_SHARE) * colors, nan=255)
            zoom = SMALL_DRAWN_PX / max(colors.shape[:2])
            size = round(zoom * colors.shape[1]), round(zoom * colors.shape[0])
            image = Image.fromarray(pale.astype(np.uint8)).resize(size, Image.Resampling.BICUBIC)
            metres_per_px = self.drawn.grid.pixel_m / zoom
        corners = self._pixels(mark) * (self.drawn.grid.pixel_m / metres_per_px)
        draw_place(image, mark, corners, SMALL_RADIUS * max(image.size))
        return small_picture(image)

    def _pixels(self, mark: Mark) -> Float64[np.ndarray, "n 2"]:
        """Pixels of a mark in the map; NaN for what is too far before or behind its plane."""
        grid, points = self.drawn.grid, np.array(mark.points, dtype=np.float64)
        corners = (grid.to_map(points) - (grid.left, grid.top)) * (1, -1) / grid.pixel_m
        corners[~grid.inside(points)] = np.nan
        return corners


def temperature_map(run: Run, scene: Scene, regions: Regions) -> TemperatureMap | None:
    """The map of a scene that has °C and metres, and is a façade or seen from above; None for all
    others.

    Args:
        run: with the model.
        scene: that it was trained on.
        regions: surfaces with an emissivity of their own, which the map shows corrected.

    Raises:
        SceneError: a photo cannot be read.
    """
    if scene.temperature is None or not scene.world.metric:
        return None
    if not (faces_one_side(scene) or _is_seen_from_above(scene)):
        return None
    baked = bake(run.model, scene.train_cameras, run.temperature)
    try:
        return draw_temperature_map(baked, scene, regions)
    except (ConfigError, RunError):
        return None


def draw_temperature_map(
    baked: BakedModel, scene: Scene, regions: Regions | None = None
) -> TemperatureMap:
    """The map of a façade, or of a scene from above.

    Args:
        baked: the model, as the photos have it.
        scene: that it was trained on.
        regions: surfaces with an emissivity of their own, which the map shows corrected.

    Raises:
        ConfigError: which way is up is not known, or pyproj is not installed.
        RunError: there is no façade.
        SceneError: a photo cannot be read.
    """
    if faces_one_side(scene):
        drawn, _ = facade_map(baked, scene, MapOptions(), most_px=MOST_PX, regions=regions)
        return TemperatureMap(drawn, True, False)
    system = coordinate_system(scene)
    drawn = map_from_above(baked, scene, system, MapOptions(), most_px=MOST_PX, regions=regions)
    return TemperatureMap(drawn, False, system.north)


def _is_seen_from_above(scene: Scene) -> bool:
    down = [-camera.forward[2].item() for camera in scene.train_cameras]
    return sum(down) / len(down) > LOOKS_DOWN
