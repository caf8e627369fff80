"""What the thermal photos of a scene show of a model's surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32

from mrgs.errors import RunError
from mrgs.export.maps.grid import MapGrid
from mrgs.pictures.files import to_array
from mrgs.runs.baked import BakedModel
from mrgs.scene import THERMAL, Camera, PosedImage, Rendering, Scene
from mrgs.scene.depth_map import MIN_ALPHA, DepthMap

SURVEY_PX = 240
"""Width of the depth maps in which surfaces are looked for."""

RENDERED, MEASURED = 0, 1
"""Channels of a photo's map: °C as the model shows them, and as the photo does."""


def survey(baked: BakedModel, scene: Scene) -> list[DepthMap]:
    """Small depth maps of the thermal photos, without images: infinite where the background is
    seen, NaN where nothing is.

    Raises:
        RunError: no photo sees a surface.
    """
    maps = []
    for image in scene.train_photos(THERMAL):
        camera = image.camera
        if camera.width > SURVEY_PX:
            camera = camera.with_width(SURVEY_PX)
        surface = scene.modalities[0]
        depth = _surface_depth(baked.render({surface: camera}, surface), scene, camera)
        maps.append(DepthMap(camera, depth, np.empty((*depth.shape, 0), np.float32)))
    if not any(np.isfinite(item.depth).any() for item in maps):
        raise RunError(
            "no view of the model is opaque enough to show a surface: train the model longer"
        )
    return maps


def median_distance(maps: Sequence[DepthMap]) -> float:
    """Median z-depth of the surfaces in depth maps."""
    return float(np.median(np.concatenate([each.depth[np.isfinite(each.depth)] for each in maps])))


def survey_pixel(maps: Sequence[DepthMap]) -> float:
    """Width of a pixel of the depth maps on the surfaces (median), scene units."""
    return median_distance(maps) / float(np.median([item.camera.K[0, 0] for item in maps]))


def on_seen_surface(
    maps: Sequence[DepthMap], points: Float32[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Whether points lie on a surface that any photo shows: what floats before it, lies behind it,
    or belongs to the sky does not."""
    found = np.zeros(len(points), bool)
    for item in maps:
        found[item.shown(points).rows] = True
    return found


class PhotoStatistics:
    """What photos show of the places of a map, gathered photo by photo.

    Args:
        points: the surface in the pixels of the map, scene coordinates; NaN where there is none,
            [H, W, 3].
        grid: the pixels.
    """

    def __init__(self, points: Float32[np.ndarray, "h w 3"], grid: MapGrid) -> None:
        self._points, self._grid = points, grid
        shape = points.shape[:2]
        self._total, self._weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self._mean, self._squares = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self.photos: Float32[np.ndarray, "h w"] = np.zeros(shape, np.float32)

    def add(self, photo: DepthMap) -> None:
        """Add a photo, see ``photo_map``."""
        window = self._grid.window_of(photo.points())
        points = self._points[window]
        surface = np.isfinite(points[..., 0])
        places = np.flatnonzero(surface)
        rows, pixels, z = photo.shown(points[surface])
        values = photo.image[pixels]
        seen = np.isfinite(values).all(axis=1)
        where = np.unravel_index(places[rows[seen]], surface.shape)
        values, near = values[seen], 1 / z[seen] ** 2
        self._total[window][where] += near * values[:, RENDERED]
        self._weight[window][where] += near
        self.photos[window][where] += 1
        step = values[:, MEASURED] - self._mean[window][where]
        self._mean[window][where] += step / self.photos[window][where]
        self._squares[window][where] += step * (values[:, MEASURED] - self._mean[window][where])

    @property
    def celsius(self) -> Float32[np.ndarray, "h w"]:
        """°C as the photos' cameras see them in the model, their mean with weights 1 / z²; NaN
        where none looked."""
        with np.errstate(invalid="ignore"):
            return self._total / self._weight

    @property
    def scatter_c(self) -> Float32[np.ndarray, "h w"]:
        """Standard deviation of the photos' readings, °C; NaN where fewer than two looked."""
        freedom = np.where(self.photos > 1, self.photos - 1, np.float32(np.nan))
        return np.sqrt(self._squares / freedom)


def photo_map(baked: BakedModel, scene: Scene, image: PosedImage) -> DepthMap:
    """A thermal photo with the depth of the model's surfaces, and °C as the model shows them and as
    the photo does (NaN where masked), [H, W, 2].

    Raises:
        SceneError: the photo cannot be read.
    """
    assert scene.temperature is not None
    assert baked.temperature is not None
    camera, pixels = image.camera, image.load()
    surface = scene.modalities[0]
    rendering = baked.render(dict.fromkeys({surface, THERMAL}, camera), surface)
    rendered = to_array(baked.temperature.to_celsius(rendering[THERMAL].image[..., 0]))
    measured = to_array(scene.temperature.to_celsius(pixels.values[..., 0]))
    if pixels.valid is not None:
        measured = np.where(pixels.valid.numpy(), measured, np.float32(np.nan))
    both = np.stack([rendered, measured], axis=2)
    return DepthMap(camera, _surface_depth(rendering, scene, camera), both)


def _surface_depth(
    rendering: Rendering, scene: Scene, camera: Camera
) -> Float32[np.ndarray, "h w"]:
    """The depth of the first modality of which there are photos, infinite where it shows the
    background."""
    depth = rendering.surface_depth(scene.modalities[0], MIN_ALPHA)
    return to_array(scene.reach.without_background(camera, depth))
