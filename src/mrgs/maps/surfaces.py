"""The pixels of an orthographic map, the camera that draws them, and what photos show there. A
camera from very far away is orthographic but for relief / distance (docs/decisions, 033)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from scipy import ndimage

from mrgs.errors import ConfigError, RunError
from mrgs.maps.crs import CoordinateSystem
from mrgs.maps.options import MapOptions
from mrgs.pictures.files import to_array
from mrgs.runs.baked import BakedModel
from mrgs.scene import THERMAL, Camera, PosedImage, Scene
from mrgs.scene.depth_map import DepthMap
from mrgs.scene.rotations import rigid_transform

Plane: TypeAlias = Float32[np.ndarray, "h w"]
"""A number for each pixel."""

TIMES_AS_FAR = 1000.0
"""Distance of the camera from the map, in lengths of the map's longer side: relief of a tenth of
that side is displaced by at most 5e-5 of it."""


@dataclass(frozen=True, eq=False)
class MapGrid:
    """A map's plane and pixels. Map coordinates are u (to the right) and v (up) in map metres.

    Attributes:
        axes: right, up and out of the plane (towards the eye) as rows, unit length, in the scene's
            coordinates, [3, 3].
        scale: map metres per scene unit.
        offset: map coordinates of the scene's origin, [2].
        left: u of the left edge.
        top: v of the upper edge.
        pixel_m: side of a pixel, map metres.
        slab: lowest and highest coordinate along ``out`` (scene units) of what is drawn.
    """

    axes: Float64[np.ndarray, "3 3"]
    scale: float
    offset: Float64[np.ndarray, "2"]
    left: float
    top: float
    pixel_m: float
    width: int
    height: int
    slab: tuple[float, float]

    def to_map(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
        """Map coordinates of points of the scene, [N, 2]."""
        return self.scale * np.einsum("ij,nj->ni", self.axes[:2], points) + self.offset

    @property
    def lower_left(self) -> Float64[np.ndarray, "3"]:
        """Scene coordinates of the map's lower left corner, in the middle of the slab."""
        return self._on_plane(self.left, self.top - self.height * self.pixel_m, sum(self.slab) / 2)

    def camera(self, column: int, row: int, width: int, height: int) -> Camera:
        """The camera of a part of the map, with upper left pixel (column, row) and its axis through
        the middle of the whole map, so that the parts fit."""
        pixel = self.pixel_m / self.scale
        distance = TIMES_AS_FAR * pixel * max(self.width, self.height)
        half_width, half_height = self.width / 2, self.height / 2
        middle = self._on_plane(
            self.left + half_width * self.pixel_m,
            self.top - half_height * self.pixel_m,
            sum(self.slab) / 2,
        )
        right, up, out = self.axes
        rotation = np.stack([right, -up, -out])
        viewmat = rigid_transform(
            rotation, -np.einsum("ij,j->i", rotation, middle + distance * out)
        )
        focal = distance / pixel
        K = [[focal, 0.0, half_width - column], [0.0, focal, half_height - row], [0.0, 0.0, 1.0]]
        return Camera(K, viewmat, width, height)

    @property
    def middles(self) -> tuple[Float64[np.ndarray, " w"], Float64[np.ndarray, " h"]]:
        """Map coordinates of the middles of the columns and of the rows."""
        u = self.left + self.pixel_m * (np.arange(self.width) + 0.5)
        v = self.top - self.pixel_m * (np.arange(self.height) + 0.5)
        return u, v

    def window_of(self, points: Float64[np.ndarray, "n 3"]) -> tuple[slice, slice]:
        """Rows and columns of the smallest part of the map with all points that are on it."""
        if not len(points):
            return slice(0, 0), slice(0, 0)
        u, v = self.to_map(points).T
        columns, rows = (u - self.left) / self.pixel_m, (self.top - v) / self.pixel_m
        return _span(rows, self.height), _span(columns, self.width)

    def inside(self, means: Float64[np.ndarray, "n 3"]) -> np.ndarray:
        """Whether points lie in the slab, [N]."""
        low, high = self.slab
        along = np.einsum("nj,j->n", means, self.axes[2])
        return (along >= low) & (along <= high)

    def pixels_of(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
        """Columns and rows of points of the scene; NaN for what is before or behind the slab."""
        pixels = (self.to_map(points) - (self.left, self.top)) * (1, -1) / self.pixel_m
        pixels[~self.inside(points)] = np.nan
        return pixels

    def shows(self, points: Float64[np.ndarray, "n 3"]) -> bool:
        """Whether all of some points of the scene are on the map."""
        pixels = self.pixels_of(points)
        return bool(((pixels >= 0) & (pixels <= (self.width, self.height))).all())

    def _on_plane(self, u: float, v: float, along: float) -> Float64[np.ndarray, "3"]:
        across = (np.array([u, v]) - self.offset) / self.scale
        return np.einsum("i,ij->j", np.append(across, along), self.axes)


def unprojected(camera: Camera, depth: np.ndarray) -> Float64[np.ndarray, "h w 3"]:
    """The points of the scene in the middles of a map's pixels, for z-depths [H, W]."""
    return camera.unproject_image(torch.from_numpy(depth.astype(np.float64))).numpy()


def _span(places: Float64[np.ndarray, " n"], size: int) -> slice:
    """The pixels from the smallest to the largest place, within the map."""
    first, last = np.clip([np.floor(places.min()), np.floor(places.max()) + 1], 0, size)
    return slice(int(first), int(last))


SURVEY_PX = 240
"""Width of the depth maps in which surfaces are looked for."""

NO_SURFACE = "no view of the model is opaque enough to show a surface: train the model longer"
RENDERED, MEASURED = 0, 1
"""Channels of a photo's map: °C as the model shows them, and as the photo does."""


def seen_surfaces(baked: BakedModel, scene: Scene) -> list[DepthMap]:
    """Small depth maps of the thermal photos, without images: infinite where the background is
    seen, NaN where nothing is. RunError if no photo sees a surface."""
    maps = []
    for image in scene.train_photos(THERMAL):
        camera = image.camera.at_most(SURVEY_PX)
        depth = _surface_depth(baked, scene, camera)
        maps.append(DepthMap(camera, depth, np.empty((*depth.shape, 0), np.float32)))
    if not any(np.isfinite(item.depth).any() for item in maps):
        raise RunError(NO_SURFACE)
    return maps


def median_distance(maps: Sequence[DepthMap]) -> float:
    """Median z-depth of the surfaces in depth maps."""
    return float(np.median(np.concatenate([each.depth[np.isfinite(each.depth)] for each in maps])))


def survey_pixel(maps: Sequence[DepthMap]) -> float:
    """Width of a pixel of the depth maps on the surfaces (median), scene units."""
    return median_distance(maps) / float(np.median([item.camera.K[0, 0] for item in maps]))


UP_SNAP = np.array([0.0, 0.0, 1.0])

MAX_TILT = 0.15
"""Root mean square of the sine by which cameras may be tilted sideways and count as level."""


def up_direction(scene: Scene) -> Float64[np.ndarray, "3"] | None:
    """The up direction, unit length [3], if the photos were taken level: perpendicular to all
    cameras' horizontal axes; None where these are not in one plane, or all parallel."""
    cameras = [camera for view in scene.train for camera in view.cameras.values()]
    rotations = np.stack([camera.viewmat[:3, :3].numpy() for camera in cameras])
    right, down, forward = rotations.transpose(1, 0, 2)
    variances, axes = np.linalg.eigh(right.T @ right / len(cameras))
    if variances[0] > MAX_TILT**2 or variances[1] < 2 * MAX_TILT**2:
        return None
    # Cameras stand upright, and look down rather than up where their own up direction says nothing.
    sign = np.sign(axes[:, 0] @ -(down + forward).mean(axis=0))
    return axes[:, 0] * (sign or 1.0)


def vertical(scene: Scene) -> Float64[np.ndarray, "3"]:
    """The up direction of a scene, unit length; ConfigError if it is not known."""
    if scene.world.north:
        return UP_SNAP
    up = up_direction(scene)
    if up is None:
        raise ConfigError(
            "which way is up in this scene is not known, because its photos were not taken level: "
            "prepare it from photos with GPS"
        )
    return UP_SNAP if up @ UP_SNAP > np.cos(np.radians(3)) else up


def pixel_size_m(
    scene: Scene,
    maps: Sequence[DepthMap],
    options: MapOptions,
    extent: Float64[np.ndarray, "2"],
    most_px: int | None,
) -> float:
    """Side of a map's pixel, metres: as wanted, or the width of a pixel of the first modality's
    photos, which are finest, on the surfaces (median), to two digits; but at most ``most_px`` fit
    on the longer side of the map's ``extent``. ``maps`` are a ``survey``."""
    focals = [float(camera.K[0, 0]) for camera in scene.train_cameras]
    size = options.pixel_size_m or float(f"{median_distance(maps) / np.median(focals):.1e}")
    return size if most_px is None else max(size, float(extent.max()) / most_px)


def on_seen_surface(
    maps: Sequence[DepthMap], points: Float32[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Whether points are on a surface that any photo shows, not before or behind it."""
    found = np.zeros(len(points), bool)
    for item in maps:
        found[item.shown(points).rows] = True
    return found


class PhotoStatistics:
    """What photos show of the places of a map, gathered photo by photo; ``points`` is the surface
    in its pixels, scene coordinates, NaN where there is none."""

    def __init__(self, points: Float32[np.ndarray, "h w 3"], grid: MapGrid) -> None:
        self._points, self._grid = points, grid
        shape = points.shape[:2]
        self._total, self._weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self._mean, self._squares = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self.photos: Plane = np.zeros(shape, np.float32)

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
    def celsius(self) -> Plane:
        """°C as the photos' cameras see them in the model, weighted by 1 / z²; else NaN."""
        with np.errstate(invalid="ignore"):
            return self._total / self._weight

    @property
    def scatter_c(self) -> Plane:
        """Standard deviation of the photos' readings, °C; NaN where fewer than two looked."""
        freedom = np.where(self.photos > 1, self.photos - 1, np.float32(np.nan))
        return np.sqrt(self._squares / freedom)


def photo_map(baked: BakedModel, scene: Scene, image: PosedImage) -> DepthMap:
    """A thermal photo with the depth of the model's surfaces, and °C as the model shows them and as
    the photo does (NaN where masked), [H, W, 2]. SceneError if the photo cannot be read."""
    assert scene.temperature is not None
    assert baked.temperature is not None
    camera, pixels = image.camera, image.load()
    thermal = baked.render({THERMAL: camera})[THERMAL].image[..., 0]
    rendered = to_array(baked.temperature.to_celsius(thermal))
    measured = to_array(scene.temperature.to_celsius(pixels.values[..., 0]))
    if pixels.valid is not None:
        measured = np.where(pixels.valid.numpy(), measured, np.float32(np.nan))
    both = np.stack([rendered, measured], axis=2)
    return DepthMap(camera, _surface_depth(baked, scene, camera), both)


def _surface_depth(baked: BakedModel, scene: Scene, camera: Camera) -> Plane:
    """The depth of the scene's first modality, infinite in the background."""
    depth = baked.median_depth(scene.modalities[0], camera)
    return to_array(scene.reach.without_background(camera, depth))


LEAST_SHARE = 0.4
"""A place belongs to a map if at least this share of as many photos show it as show the place that
most do. Beyond, a few photos show it from the side, and the map would end in rags."""

SMOOTHED_CELLS = 1.5
"""Standard deviation of the filter over the numbers of photos, in cells."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """How many photos show the places of a map, as a share of the most that count, in square
    cells of ``cell_m`` map metres from the map coordinates ``low`` on."""

    low: Float64[np.ndarray, "2"]
    cell_m: float
    share: Float64[np.ndarray, "u v"]

    @classmethod
    def of(
        cls,
        places: Iterable[Float64[np.ndarray, "_ 2"]],
        cell_m: float,
        enough: float = math.inf,
    ) -> Coverage:
        """Count photos by the map coordinates of what each shows, [N, 2], at least one place in
        all; a cell must be so wide that a photo misses none that it shows. Of photos that were
        chosen so that ``enough`` show each place, more do not count."""
        cells = [_once(np.floor(each / cell_m).astype(np.int64)) for each in places if len(each)]
        every = np.concatenate(cells)
        first = every.min(axis=0)
        photos = np.zeros(every.max(axis=0) - first + 1)
        for each in cells:
            photos[tuple((each - first).T)] += 1
        smooth = ndimage.gaussian_filter(photos, SMOOTHED_CELLS, mode="constant")
        return cls(first * cell_m, cell_m, smooth / min(smooth.max(), enough))

    @property
    def bounds(self) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2"]]:
        """The smallest and the largest map coordinates of what enough photos show."""
        cells = np.argwhere(self.share >= LEAST_SHARE)
        first, last = cells.min(axis=0), cells.max(axis=0) + 1
        return self.low + first * self.cell_m, self.low + last * self.cell_m

    def covers(
        self, u: Float64[np.ndarray, " w"], v: Float64[np.ndarray, " h"]
    ) -> Bool[np.ndarray, "h w"]:
        """Whether enough photos show the places of a grid, [H, W]."""
        columns, rows = (
            (each - low) / self.cell_m - 0.5 for each, low in zip((u, v), self.low, strict=True)
        )
        at = np.stack(np.meshgrid(columns, rows))
        share = ndimage.map_coordinates(self.share, at, order=1, mode="constant")
        covered: Bool[np.ndarray, "h w"] = ndimage.binary_fill_holes(share >= LEAST_SHARE)
        return covered


def _once(cells: Int64[np.ndarray, "n 2"]) -> Int64[np.ndarray, "k 2"]:
    """Each cell once."""
    first, shape = cells.min(axis=0), np.ptp(cells, axis=0) + 1
    numbers = np.unique(np.ravel_multi_index(tuple((cells - first).T), shape))
    return first + np.stack(np.unravel_index(numbers, shape), axis=1)


TIMES_MEDIAN = 2.5
"""The map shows surfaces within this multiple of the photos' median distance: others are coarse."""

CELL_PX = 4
"""Side of the cells in which photos are counted, in pixels of the survey at the median distance."""


def grid_from_above(
    scene: Scene,
    maps: Sequence[DepthMap],
    system: CoordinateSystem,
    options: MapOptions,
    most_px: int | None = None,
    enough: float = math.inf,
) -> tuple[MapGrid, Coverage]:
    """The pixels of the map of a scene from above, in the coordinates of ``system``, by a
    ``survey``, and what enough photos show of it (``Coverage.of``); for the others see
    ``facade_grid``. ConfigError if the vertical is not known."""
    axes, scale, offset = _plan_view(system, vertical(scene))
    limit = TIMES_MEDIAN * median_distance(maps)
    heights: list[float] = []

    def places() -> Iterator[Float64[np.ndarray, "_ 2"]]:
        """What each photo shows; together it would take gigabytes."""
        for item in maps:
            near = replace(item, depth=np.where(item.depth < limit, item.depth, np.inf))
            points = near.points()
            along = points @ axes[2]
            heights.extend((float(along.min()), float(along.max())) if len(points) else ())
            yield scale * points @ axes[:2].T + offset

    coverage = Coverage.of(places(), CELL_PX * scale * survey_pixel(maps), enough)
    slab = min(heights), max(heights)
    low, high = coverage.bounds
    pixel_m = pixel_size_m(scene, maps, options, high - low, most_px)
    # The edges are multiples of the pixel size, as GIS expect of neighbouring maps.
    first, last = np.floor(low / pixel_m).astype(int), np.ceil(high / pixel_m).astype(int)
    width, height = (max(int(size), 1) for size in last - first)
    left, top = float(first[0] * pixel_m), float(last[1] * pixel_m)
    return MapGrid(axes, scale, offset, left, top, pixel_m, width, height, slab), coverage


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
    axes = np.stack([right, np.cross(up, right), up])
    return axes, 1.0, np.einsum("ij,j->i", axes[:2], system.matrix[:3, 3])


CELL = 1.5
"""Side of the cells in which the surfaces of several photos are put together, in their pixels."""

LEAST_POINTS = 3
"""Fewer of them in a cell are not a surface."""


class ShownPlaces:
    """The surfaces in the pixels of a map, by a ``survey``: from far away a model also shows what
    floats before its surfaces, and what is behind gaps between its splats."""

    def __init__(self, maps: Sequence[DepthMap], grid: MapGrid) -> None:
        self._grid = grid
        self._maps = [(item, grid.window_of(item.points())) for item in maps]
        self._cell_px = max(math.ceil(CELL * survey_pixel(maps) * grid.scale / grid.pixel_m), 1)

    def depth_of_part(self, part: tuple[slice, slice], camera: Camera, depth: Plane) -> Plane:
        """The depth that the camera of a part (rows and columns) of the map sees, where a photo
        shows that surface; elsewhere that of the photos' own surfaces, else NaN, [H, W]."""
        points = unprojected(camera, depth).astype(np.float32)
        near = [
            (item, window)
            for item, window in self._maps
            if all(a.start < b.stop and b.start < a.stop for a, b in zip(window, part, strict=True))
        ]
        found = np.zeros(depth.shape, bool)
        for item, window in near:
            there = tuple(map(_within, window, part))
            unknown = np.isfinite(points[there][..., 0]) & ~found[there]
            places = np.flatnonzero(unknown)
            rows = item.shown(points[there][unknown]).rows
            found[there][np.unravel_index(places[rows], unknown.shape)] = True
        every = (item.points() for item, _ in near)
        inside = (points[self._grid.inside(points)] for points in every)
        return np.where(found, depth, _depth_of_cells(camera, inside, self._cell_px, ~found))


def _within(span: slice, part: slice) -> slice:
    """The indices of a span that lie in a part, counted from the part's first."""
    low, high = (min(max(end, part.start), part.stop) for end in (span.start, span.stop))
    return slice(low - part.start, high - part.start)


def _depth_of_cells(
    camera: Camera,
    points: Iterable[Float64[np.ndarray, "_ 3"]],
    cell_px: int,
    wanted: Bool[np.ndarray, "h w"],
) -> Plane:
    """The median depth of the points of all photos in square cells of an image, in all of their
    pixels; NaN in cells with fewer than ``LEAST_POINTS``, or without a wanted pixel."""
    across, down = (-(-size // cell_px) for size in (camera.width, camera.height))
    rows, columns = np.nonzero(wanted)
    lacking = np.zeros(across * down, bool)
    lacking[rows // cell_px * across + columns // cell_px] = True
    found, z = [np.empty(0, np.int64)], [np.empty(0)]
    for each in points if len(rows) else ():
        pixels, depth = camera.project(torch.from_numpy(each))
        inside = camera.contains(pixels)
        column, row = (pixels[inside] / cell_px).long().unbind(dim=1)
        numbers = (row * across + column).numpy()
        found.append(numbers[lacking[numbers]])
        z.append(depth[inside].numpy()[lacking[numbers]])
    cells, depths = np.concatenate(found), np.concatenate(z)
    order = np.lexsort([depths, cells])
    taken, first, count = np.unique(cells[order], return_index=True, return_counts=True)
    many = count >= LEAST_POINTS
    medians = np.full(across * down, np.nan, np.float32)
    medians[taken[many]] = depths[order][(first + count // 2)[many]]
    whole = medians.reshape(down, across).repeat(cell_px, axis=0).repeat(cell_px, axis=1)
    return whole[: camera.height, : camera.width]
