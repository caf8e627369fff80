"""What cameras see of a model's surfaces, carried over to points in space."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64
from scipy import sparse

from mrgs.scene.camera import Camera
from mrgs.scene.modality import THERMAL
from mrgs.scene.rendering import Rendering
from mrgs.scene.view import evenly_spaced
from mrgs.scene.world import SceneBounds
from mrgs.system.memory import row_chunks
from mrgs.system.torch_modes import own_modes

Points: TypeAlias = Float32[np.ndarray, "n 3"]
SurfaceRenderer: TypeAlias = Callable[[Camera], Rendering]
"""Renders all modalities of a model from a camera, with the depths of their surfaces."""

MAX_WIDTH_PX = 480
"""Largest width of images: memory and time."""

ALWAYS, ENOUGH = 64, 4
"""Cameras that are surveyed in any case, and cameras by which a place is measured."""

POINTS, NEW = 5000, 0.1
"""Points of the scene by which cameras are counted; and the share of its points that a further
camera must show to which the others are too few."""

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
    channels = maps[0].image.shape[2] if maps else 1
    total = np.zeros((len(points), channels), dtype=np.float32)
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


def surveying(
    cameras: Sequence[Camera], points: Points, always: int = ALWAYS, enough: int = ENOUGH
) -> list[int]:
    """Indices of as many cameras as are needed to measure what they show: ``always``, spread
    evenly, and further ones, those first that show most points that fewer than ``enough`` have in
    their images, as long as these are a share ``NEW`` of their points."""
    chosen = evenly_spaced(len(cameras), always)
    if len(chosen) == len(cameras):
        return chosen
    points = points[np.random.default_rng(0).permutation(len(points))[:POINTS]]
    rows = [visible(camera, points).rows for camera in cameras]
    ends = np.cumsum([0, *map(len, rows)])
    ones, shape = np.ones(ends[-1], int), (len(cameras), len(points))
    shown = sparse.csr_matrix((ones, np.concatenate(rows), ends), shape)
    counts = np.asarray(shown[chosen].sum(axis=0)).ravel()
    while True:
        lacking = shown @ (counts < enough)
        lacking[lacking <= NEW * np.diff(ends)] = 0
        lacking[chosen] = 0
        best = int(lacking.argmax())
        if not lacking[best]:
            return sorted(chosen)
        counts[rows[best]] += 1
        chosen.append(best)


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


class DepthMaps:
    """The depth maps of cameras by their numbers, each made when it is first asked for."""

    def __init__(self, cameras: Sequence[Camera], make: Callable[[int], DepthMap]) -> None:
        self.cameras = cameras
        self._make = make
        self._made: dict[int, DepthMap] = {}

    def __getitem__(self, number: int) -> DepthMap:
        if number not in self._made:
            self._made[number] = self._make(number)
        return self._made[number]

    def __iter__(self) -> Iterator[DepthMap]:
        return (self[number] for number in range(len(self.cameras)))

    def near(self, points: Points) -> Iterator[tuple[int, DepthMap]]:
        """The maps that have any of the points in their image; the others are not made."""
        return ((number, self[number]) for number in self._near(points))

    def made_near(self, points: Points) -> bool:
        """Whether all maps that have any of the points in their image have been made."""
        return all(number in self._made for number in self._near(points))

    def _near(self, points: Points) -> Iterator[int]:
        if not len(points) or not len(self.cameras):
            return
        low, high = points.min(axis=0), points.max(axis=0)
        middle, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
        inside = (self._sides[:, :, :3] @ middle + self._sides[:, :, 3]).min(axis=1) >= -radius
        for number in np.flatnonzero(inside).tolist():
            if len(visible(self.cameras[number], points).rows):
                yield number

    @cached_property
    def _sides(self) -> Float64[np.ndarray, "c 4 4"]:
        """The planes through a camera's eye and the sides of its image: distances inwards are their
        products with places and 1."""
        found = []
        for camera in self.cameras:
            (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
            right, down = camera.width - cx, camera.height - cy
            sides = np.array([[fx, 0, cx], [-fx, 0, right], [0, fy, cy], [0, -fy, down]])
            sides /= np.linalg.norm(sides, axis=1, keepdims=True)
            found.append(sides @ camera.viewmat[:3].numpy())
        return np.stack(found)


class PhotoSurvey(DepthMaps):
    """What cameras, such as those of ``Scene.survey_views``, see of the model: depth and normalised
    temperature; no temperature on outlines."""

    def __init__(self, render: SurfaceRenderer, cameras: Sequence[Camera]) -> None:
        super().__init__(cameras, self._seen)
        self._render = render

    @own_modes()
    def _seen(self, number: int) -> DepthMap:
        small = self.cameras[number].at_most(MAX_WIDTH_PX)
        rendering = self._render(small).cpu()
        values = torch.full((small.height, small.width), torch.nan)
        if THERMAL in rendering:
            inner = rendering.surface_depth(THERMAL, max_step=MAX_STEP).isfinite()
            values = torch.where(inner, rendering[THERMAL].image[..., 0], values)
        depth = rendering.visible_depth().float().numpy()
        return DepthMap(small, depth, values[..., None].numpy())

    def temperatures(self, points: Points, least: int = 1) -> Float32[np.ndarray, " n"]:
        """What the cameras see at points on surfaces, NaN where fewer than ``least`` see one, [N],
        normalised: the temperature of a place, wherever one is stated."""
        maps = [each for _, each in self.near(points)]
        values, cameras = carry_over(maps, points, 0.0, SURFACE_DEPTH)
        return np.where(cameras >= least, values[:, 0], np.float32(np.nan))
