"""What cameras see of a model's surfaces, carried over to points in space."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64

from mrgs.scene.camera import Camera
from mrgs.scene.modality import THERMAL
from mrgs.scene.rendering import Rendering
from mrgs.scene.view import evenly_spaced
from mrgs.scene.world import SceneBounds
from mrgs.system.memory import row_chunks

Points: TypeAlias = Float32[np.ndarray, "n 3"]
SurfaceRenderer: TypeAlias = Callable[[Camera], Rendering]
"""Renders all modalities of a model from a camera, with the depths of their surfaces."""

MAX_VIEWS = 64
MAX_WIDTH_PX = 480
"""Largest number of cameras, and width of their images: memory and time."""

MIN_ALPHA = 0.5
"""A pixel that lets through more light than this has no depth."""

SURFACE_DEPTH = 0.03
"""A point is on a surface that a camera sees if the two depths differ by less than this share."""

MAX_STEP = 0.05
"""A pixel whose neighbours' depths differ by more than this share is on an outline: no depth."""


class PointsInImage(NamedTuple):
    """Some of the points that were asked for, as a camera has them in its image: their places among
    the points, row and column of the pixel of each, and z-depths in scene units."""

    rows: Int64[np.ndarray, " m"]
    pixels: tuple[Int64[np.ndarray, " m"], Int64[np.ndarray, " m"]]
    z: Float32[np.ndarray, " m"]


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depth and image of one camera: z-depth in scene units, infinite where nothing but the sky is
    seen, NaN where it is not known; any C channels to be carried over to the surface."""

    camera: Camera
    depth: Float32[np.ndarray, "h w"]
    image: Float32[np.ndarray, "h w c"]

    def points(self, offset: float = 0.0) -> Float64[np.ndarray, "m 3"]:
        """World coordinates of the pixels with a depth, ``offset`` (scene units) added to it."""
        row, column = np.nonzero(np.isfinite(self.depth))
        pixels = torch.from_numpy(np.stack([column, row], axis=1) + 0.5)
        depth = torch.from_numpy(self.depth[row, column].astype(np.float64))
        return self.camera.unproject(pixels, depth + offset).numpy()

    def shown(
        self, points: Points, relative_tolerance: float = SURFACE_DEPTH, tolerance: float = 0.0
    ) -> PointsInImage:
        """The points that lie on the surface which the camera sees: no farther before or behind the
        depth of their pixel than the larger of ``tolerance``, scene units, and
        ``relative_tolerance``, as a share of their depth."""
        rows, pixels, z = visible(self.camera, points)
        away = np.abs(self.depth[pixels] - z)
        seen = away < np.maximum(tolerance, relative_tolerance * z)  # false for NaN
        return PointsInImage(rows[seen], (pixels[0][seen], pixels[1][seen]), z[seen])


def carry_over(
    maps: Sequence[DepthMap], points: Points, tolerance: float, relative_tolerance: float = 0.0
) -> tuple[Float32[np.ndarray, "n c"], Int64[np.ndarray, " n"]]:
    """Image values of each point [N, C], averaged over the cameras that see it with weights 1 / z²,
    and the number of these cameras [N]. Pixels with NaN do not count. For the tolerances see
    ``DepthMap.shown``."""
    total = np.zeros((len(points), maps[0].image.shape[2]), dtype=np.float32)
    weight = np.zeros(len(points), dtype=np.float32)
    cameras = np.zeros(len(points), dtype=np.int64)
    for item in maps:
        rows, pixels, z = item.shown(points, relative_tolerance, tolerance)
        values = item.image[pixels]
        known = np.isfinite(values).all(axis=1)
        rows, near = rows[known], 1 / z[known] ** 2
        total[rows] += near[:, None] * values[known]
        weight[rows] += near
        cameras[rows] += 1
    return total / np.where(weight > 0, weight, 1)[:, None], cameras


def visible(camera: Camera, positions: Points) -> PointsInImage:
    """The points inside a camera's image."""
    found = []
    for chunk in row_chunks(len(positions)):
        pixels, depth = camera.project(torch.from_numpy(positions[chunk]))
        rows = camera.contains(pixels).nonzero()[:, 0]
        column, line = pixels[rows].long().unbind(dim=1)
        found.append((rows + chunk.start, column, line, depth[rows]))
    places, x, y, z = (torch.cat(parts).numpy() for parts in zip(*found, strict=True))
    return PointsInImage(places, (y, x), z)


def surveying_cameras(cameras: Sequence[Camera]) -> list[Camera]:
    """At most ``MAX_VIEWS`` of the cameras, spread evenly, at most ``MAX_WIDTH_PX`` wide."""
    chosen = [cameras[index] for index in evenly_spaced(len(cameras), MAX_VIEWS)]
    return [
        camera if camera.width <= MAX_WIDTH_PX else camera.with_width(MAX_WIDTH_PX)
        for camera in chosen
    ]


def before_background(render: SurfaceRenderer, bounds: SceneBounds | None) -> SurfaceRenderer:
    """Renders a model without the background of its scene, where the bounds are known: nothing can
    be measured on the sky."""
    if bounds is None:
        return render

    def draw(camera: Camera) -> Rendering:
        def nearer(depth: Float[torch.Tensor, "h w"]) -> Float[torch.Tensor, "h w"]:
            known = bounds.without_background(camera, depth)
            return torch.where(known.isinf(), torch.nan, known)

        return render(camera).with_depths(nearer)

    return draw


class PhotoSurvey:
    """What the photos' cameras see of the model, rendered when it is first asked for. ``chosen``
    are the indices of the cameras that are surveyed, at most ``MAX_VIEWS``, spread evenly."""

    def __init__(self, render: SurfaceRenderer, cameras: Sequence[Camera]) -> None:
        self.chosen = evenly_spaced(len(cameras), MAX_VIEWS)
        self._render = render
        self.cameras = [cameras[index] for index in self.chosen]
        self.maps: list[DepthMap] = []

    def __iter__(self) -> Iterator[DepthMap]:
        """Depth and normalised temperature of each camera that is surveyed, in the order of
        ``chosen``; no temperature on outlines."""
        if not self.maps:
            maps = []  # all or none, if a rendering fails
            for small in surveying_cameras(self.cameras):
                rendering = self._render(small).cpu()
                values = torch.full((small.height, small.width), torch.nan)
                if THERMAL in rendering:
                    inner = rendering.surface_depth(THERMAL, max_step=MAX_STEP).isfinite()
                    values = torch.where(inner, rendering[THERMAL].image[..., 0], values)
                depth = rendering.visible_depth().float().numpy()
                maps.append(DepthMap(small, depth, values[..., None].numpy()))
            self.maps = maps
        return iter(self.maps)

    def temperatures(self, points: Points, least: int = 1) -> Float32[np.ndarray, " n"]:
        """What the cameras see at points on surfaces, NaN where fewer than ``least`` see one, [N],
        normalised: the temperature of a place, wherever one is stated."""
        values, cameras = carry_over(list(self), points, 0.0, SURFACE_DEPTH)
        return np.where(cameras >= least, values[:, 0], np.float32(np.nan))
