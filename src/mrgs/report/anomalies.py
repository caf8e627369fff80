"""The anomalies that the report proposes: the hottest and the coldest spots of a model, kept in the
run until they are accepted or dropped. They are surfaces that several views agree on, never single
splats.

A splat's own temperature means little, as neighbours make up for each other. So the spots are read
from renderings, as a thermographer reads them from photos:

1. Every view's thermal camera is rendered. Pixels that show a surface whose depth does not jump
  become points in the scene; not so those beside an outline and near the sky.
2. The points are gathered in cubes of the size of 3×3 pixels, the usual spot of a spot meter. A
  view's value of a cube is the mean of its points there.
3. The value of a cube is the median over its views, at least three: a reflection that few views
  catch does not count.
4. Cubes that more views see through than see are left out: mist, and outlines before the sky.
5. The extreme cubes are taken one by one, each away from those before it and from the points of
  marks that were judged before. One is left out that no view has away from its border, that does
  not differ from its surroundings, or that is part of something as extreme that is large and
  reaches the border of the picture: the sky. The most extreme cube that is not near the edge of
  what is as extreme stands for it. It is proposed if its uncertainty is small.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy.ndimage import distance_transform_edt, label

from mrgs.marks import MarkReading, RunMarks
from mrgs.marks.mark import Mark, places_of
from mrgs.marks.regions import Regions
from mrgs.marks.resolution import square_about
from mrgs.marks.run_marks import spot_radius
from mrgs.pictures.files import to_array
from mrgs.scene import THERMAL, Camera, Rendering, Scene, SceneBounds, View
from mrgs.scene.depth_map import DepthMap, SurfaceRenderer, visible
from mrgs.survey import Survey

WIDTH_PX, MANY = 320, 150
"""Width of the renderings that are searched; narrower for more views than this, for memory."""

SURFACE_ALPHA = 0.9
DEPTH_JUMP = 0.1
"""Relative difference of depth within 3×3 pixels above which a pixel counts as an edge."""

OUTLINE_SHARE, SKY_SHARE = 0.006, 0.025
"""Pixels that lie nearer to an outline, or to pixels without a surface, than these shares of the
image's width do not count."""

CUBE_PX = 3
CELL_BITS = 21
"""Bits of a cube's number per axis; anything farther away counts as one cube."""

MIN_POINTS = 3
"""Smallest number of points of a view in a cube; fewer are a sliver at a grazing angle."""

LARGE_SHARE = 0.04
"""Share of a picture above which something that reaches its border is not an anomaly."""

LEFT_OUT_SHARE = 0.2
"""Share of the separation within which neighbours of a rejected cube are skipped."""

WITHIN_PX, BESIDE_PX = 3, 6
"""Within the edge of what is as extreme places are measured; beside it they belong to it."""

LEAST_CONTRAST = 0.01
"""Smallest difference of a spot to the median about it, as a share of the recorded range."""

AS_EXTREME = 0.1
"""What differs from a spot by less than this share of the range about it is as extreme."""

MIN_VIEWS = 3
SEPARATION_CUBES = 15

SAME_DEPTH = 0.05
"""A view sees a place if its rendered depth there differs by less than this share."""


class Spot(NamedTuple):
    """A spot on a surface: world coordinates by the view that shows it best, of index ``view``;
    normalised temperatures, the median over the ``views`` that see it, 10th and 90th percentile."""

    position: Float[np.ndarray, "3"]
    value: float
    low: float
    high: float
    views: int
    view: int


class _Points(NamedTuple):
    """Surface points of all views, [P]: world coordinates, normalised temperatures, indices of
    their views, and whether the pixel is away from the image's border; the median distance between
    neighbouring pixels on the surfaces (scene units), and the rendered views by their indices."""

    positions: Float[np.ndarray, "p 3"]
    values: Float[np.ndarray, " p"]
    views: Int64[np.ndarray, " p"]
    central: Bool[np.ndarray, " p"]
    footprint: float
    images: dict[int, DepthMap]


class _Sightings(NamedTuple):
    """The S values that views have in cubes, sorted by cube: mean value and position of the view's
    points there, and their number, 0 if they touch the image's border."""

    cubes: Int64[np.ndarray, " s"]
    views: Int64[np.ndarray, " s"]
    values: Float[np.ndarray, " s"]
    positions: Float[np.ndarray, "s 3"]
    points: Int64[np.ndarray, " s"]


class _Cube(NamedTuple):
    """The values of V views in one cube, ascending, and the rows of their sightings."""

    median: float
    values: Float[np.ndarray, " v"]
    rows: Int64[np.ndarray, " v"]


def find_spots(
    views: Sequence[View],
    render: SurfaceRenderer,
    count: int = 3,
    ball: SceneBounds | None = None,
    judged: Sequence[Float[np.ndarray, "_ 3"]] = (),
) -> tuple[list[Spot], list[Spot]]:
    """The hottest and the coldest spots, at most ``count`` of each, the most extreme first; none in
    the sky beyond ``ball``, nor near to all points [N, 3] of a ``judged`` mark."""
    chosen = [index for index, view in enumerate(views) if THERMAL in view.images]
    points = _survey(views, chosen, render, ball)
    if points is None:
        return [], []
    sightings, edge = _sightings(points)
    cubes = _agreed(sightings, min(MIN_VIEWS, len(chosen)))
    cubes = _solid(cubes, sightings, points.images.values())
    distance = SEPARATION_CUBES * edge
    hottest, coldest = (
        _apart(row, sign, sightings, points.images, count, distance, judged)
        for row, sign in ((cubes[::-1], 1), (cubes, -1))
    )
    return hottest, coldest


def _survey(
    views: Sequence[View], chosen: Sequence[int], render: SurfaceRenderer, ball: SceneBounds | None
) -> _Points | None:
    """Step 1: the surface points of the chosen views; None if there are none."""
    parts, images = [], {}
    widest = round(WIDTH_PX * min(1.0, MANY / max(len(chosen), 1)) ** 0.5)
    for index in chosen:
        camera = views[index].images[THERMAL].camera.at_most(widest)
        rendering = render(camera)
        image = rendering[THERMAL].image[..., 0].numpy()
        depth = rendering.surface_depth(THERMAL).float().numpy()
        images[index] = DepthMap(camera, depth, rendering[THERMAL].image.float().numpy())
        depth_map = _inner_depth(rendering, camera, ball).numpy()
        rows, columns = np.nonzero(np.isfinite(depth_map))
        values, distance = image[rows, columns], depth_map[rows, columns]
        border = 0.1 * min(camera.width, camera.height)
        central = (np.minimum(columns, camera.width - columns) > border) & (
            np.minimum(rows, camera.height - rows) > border
        )
        footprint = distance / camera.K[0, 0].item()
        pixels = torch.from_numpy(np.stack([columns, rows], axis=1) + 0.5)
        positions = camera.unproject(pixels, torch.from_numpy(distance)).numpy()
        parts.append((positions, values, np.full(len(rows), index), central, footprint))
    if not sum(len(part[0]) for part in parts):
        return None
    positions, values, owners, central, footprints = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    return _Points(positions, values, owners, central, float(np.median(footprints)), images)


def _inner_depth(
    rendering: Rendering, camera: Camera, ball: SceneBounds | None
) -> Float[torch.Tensor, "h w"]:
    """z-depth of the surfaces, NaN beside outlines and near the sky."""
    solid = rendering.surface_depth(THERMAL, SURFACE_ALPHA).double()
    surface = rendering.surface_depth(THERMAL, SURFACE_ALPHA, DEPTH_JUMP).double()
    if ball is not None:
        solid, surface = (ball.without_background(camera, each) for each in (solid, surface))
    outlines = _widened(surface.isnan(), round(OUTLINE_SHARE * camera.width))
    left_out = outlines | _widened(solid.isnan(), round(SKY_SHARE * camera.width))
    return torch.where(left_out, torch.nan, surface)


def _widened(mask: Bool[torch.Tensor, "h w"], pixels: int) -> Bool[torch.Tensor, "h w"]:
    """A mask grown by a number of pixels."""
    grown = torch.nn.functional.max_pool2d(mask[None].float(), 2 * pixels + 1, 1, pixels)
    return grown[0] > 0


def _sightings(points: _Points) -> tuple[_Sightings, float]:
    """Step 2, and the edge of the cubes in scene units."""
    edge = CUBE_PX * points.footprint
    cells = np.floor(points.positions / edge)
    x, y, z = np.minimum(cells - cells.min(axis=0), 2**CELL_BITS - 1).astype(np.int64).T
    cubes = (x << 2 * CELL_BITS) | (y << CELL_BITS) | z
    order = np.lexsort((points.views, cubes))
    cubes, views = cubes[order], points.views[order]
    starts = np.flatnonzero(np.r_[True, (np.diff(cubes) != 0) | (np.diff(views) != 0)])
    number = np.diff(np.r_[starts, len(order)])
    values = np.add.reduceat(points.values[order].astype(np.float64), starts) / number
    positions = np.add.reduceat(points.positions[order], starts) / number[:, None]
    central = np.logical_and.reduceat(points.central[order], starts)
    enough = number >= MIN_POINTS
    sightings = (cubes[starts], views[starts], values, positions, np.where(central, number, 0))
    return _Sightings(*(column[enough] for column in sightings)), edge


def _agreed(sightings: _Sightings, min_views: int) -> list[_Cube]:
    """Step 3: every cube that enough views see, the coldest first."""
    order = np.lexsort((sightings.values, sightings.cubes))
    values = sightings.values[order]
    starts = np.flatnonzero(np.r_[True, np.diff(sightings.cubes) != 0][: len(values)])
    numbers = np.diff(np.r_[starts, len(values)])
    medians = (values[starts + (numbers - 1) // 2] + values[starts + numbers // 2]) / 2
    enough = np.flatnonzero(numbers >= min_views)
    ranked = enough[np.argsort(medians[enough], kind="stable")]
    parts = [slice(starts[i], starts[i] + numbers[i]) for i in ranked]
    return [
        _Cube(medians[i], values[part], order[part]) for i, part in zip(ranked, parts, strict=True)
    ]


def _solid(cubes: list[_Cube], sightings: _Sightings, images: Iterable[DepthMap]) -> list[_Cube]:
    """Step 4: the cubes that at least as many views see as see through them."""
    if not cubes:
        return []
    places = sightings.positions[[cube.rows[0] for cube in cubes]].astype(np.float32)
    seen, passed = np.zeros(len(cubes), int), np.zeros(len(cubes), int)
    for item in images:
        inside, pixels, z = visible(item.camera, places)
        share = item.depth[pixels] / z
        seen[inside] += np.abs(share - 1) <= SAME_DEPTH
        passed[inside] += np.isnan(share) | (share > 1 + SAME_DEPTH)
    return [cubes[index] for index in np.flatnonzero(seen >= passed)]


def _apart(
    cubes: Sequence[_Cube],
    sign: int,
    sightings: _Sightings,
    images: Mapping[int, DepthMap],
    count: int,
    distance: float,
    judged: Sequence[Float[np.ndarray, "_ 3"]],
) -> list[Spot]:
    """Step 5: the first cubes of the list that keep the distance from each other and from judged
    marks; hot ones where the sign is 1, cold ones where it is −1."""
    kept: list[Spot] = []
    places = sightings.positions[[cube.rows[0] for cube in cubes]]
    free = np.full(len(cubes), count > 0)
    for mark in judged:
        free &= np.linalg.norm(places[:, None] - mark, axis=2).max(axis=1, initial=0) >= distance
    for index, cube in enumerate(cubes):
        if not free[index]:
            continue
        best = cube.rows[np.argmax(sightings.points[cube.rows])]
        # The place in one view: the mean of the places in several views may be beside it,
        # where the temperature changes by degrees within a pixel.
        position = sightings.positions[best]
        away = np.linalg.norm(places - position, axis=1)
        view, within = int(sightings.views[best]), None
        if sightings.points[best]:
            within = _px_within(images[view], places, position, cube.median, sign)
        if within is None:
            free &= away >= LEFT_OUT_SHARE * distance
            continue
        place = int(np.where(free, within.clip(0, WITHIN_PX), 0).argmax())
        free &= (away >= distance) & (within < -BESIDE_PX)
        seen = cubes[place].rows[sightings.views[cubes[place].rows] == view]
        if within[place] > 0 and len(seen):
            cube, position = cubes[place], sightings.positions[seen[0]]
            free &= np.linalg.norm(places - position, axis=1) >= distance
        low, high = np.quantile(cube.values, [0.1, 0.9])
        kept.append(Spot(position, cube.median, float(low), float(high), len(cube.rows), view))
        if len(kept) == count:
            break
    return kept


def _px_within(
    image: DepthMap,
    places: Float[np.ndarray, "n 3"],
    position: Float[np.ndarray, "3"],
    value: float,
    sign: int,
) -> Float[np.ndarray, " n"] | None:
    """How far places that a picture shows are within the edge of what about a position is as
    extreme, pixels, negative outside; None if the position does not stand out of the picture, or is
    part of something large that reaches the picture's border."""
    x, y = image.camera.project(torch.from_numpy(position))[0].tolist()
    values = image.image[..., 0]
    about = values[square_about((image.camera.width, image.camera.height), x, y)]
    low, middle, high = np.percentile(about, [2, 50, 98])
    if not sign * (value - middle) > max(AS_EXTREME * (high - low), LEAST_CONTRAST):
        return None
    parts, _ = label(sign * (values - value) >= -AS_EXTREME * (high - low))
    within = np.full(len(places), -np.inf)
    if parts[int(y), int(x)]:
        own = parts == parts[int(y), int(x)]
        reaches = own[0].any() or own[-1].any() or own[:, 0].any() or own[:, -1].any()
        if reaches and own.mean() > LARGE_SHARE:
            return None
        rows, pixels, _ = image.shown(places.astype(np.float32), SAME_DEPTH)
        within[rows] = (distance_transform_edt(own) - distance_transform_edt(~own))[pixels]
    return within


def surroundings(view: View, spot: Spot, rendering: Rendering) -> float:
    """Normalised temperature about a spot: the median of the pixels about it that show a surface;
    that of the spot where none does."""
    camera = view.images[THERMAL].camera
    column, row = _pixel(camera, spot)
    part = square_about((camera.width, camera.height), column, row)
    values = to_array(rendering[THERMAL].image[..., 0])[part]
    solid = np.isfinite(to_array(rendering.surface_depth(THERMAL))[part])
    return float(np.median(values[solid])) if solid.any() else spot.value


def photo_value(view: View, spot: Spot) -> float | None:
    """Normalised temperature of the thermal photo at a spot: the mean of 3×3 pixels; None where
    none is valid."""
    photo = view.images[THERMAL]
    pixels = photo.load()
    values = to_array(pixels.values[..., 0])
    if pixels.valid is not None:
        values = np.where(pixels.valid.numpy(), values, np.nan)
    column, row = (int(value) for value in _pixel(photo.camera, spot))
    patch = values[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    return float(np.nanmean(patch)) if patch.size and np.isfinite(patch).any() else None


def _pixel(camera: Camera, spot: Spot) -> tuple[float, float]:
    """Column and row of a spot, perhaps outside the image; NaN behind the camera."""
    column, row = camera.project(torch.from_numpy(spot.position))[0].tolist()
    return column, row


PROPOSED = 3
"""Largest number of hot places, and of cold ones, unless the survey sets them."""

CANDIDATES = 2
"""Candidates measured per proposal."""

LEAST_PHOTOS = 2
"""Number of photos that must see a proposed place."""

LEAST_CERTAINTY, LARGEST_UNCERTAINTY_C = 10.0, 5.0
"""Least contrast of a proposed place in multiples of its uncertainty, and the largest one, K."""


class Anomaly(NamedTuple):
    """A spot, its reading as a mark, and its temperature minus that of its surroundings."""

    spot: Spot
    reading: MarkReading
    contrast: float

    @property
    def certainty(self) -> float:
        """Contrast over its uncertainty, without the parts by camera and settings, which the
        surroundings share; infinite where that is not known."""
        around = None if self.reading.uncertainty is None else self.reading.uncertainty.own
        return abs(self.contrast) / around if around is not None and around > 0 else np.inf

    @property
    def stands_out(self) -> bool:
        """Whether its uncertainty is small, in itself and against the contrast."""
        return self.certainty >= max(LEAST_CERTAINTY, abs(self.contrast) / LARGEST_UNCERTAINTY_C)


class Proposals(NamedTuple):
    """Anomalies that the report proposes, by name, the most certain first; and how many were as hot
    or as cold, but do not stand out of their uncertainty."""

    anomalies: Mapping[str, Anomaly]
    held_back: int


def propose(marks: RunMarks, scene: Scene, regions: Regions, survey: Survey) -> Proposals:
    """Find the hottest and the coldest spots that stand out, and keep them in the run as its
    proposals; the survey may set their numbers.

    None is made again where a mark was made, or a proposal dropped, unless in a large area, which
    does not judge a place in it. A spot that was proposed before keeps its name. SceneError if a
    photo cannot be read, RunError if the marks cannot be read or saved.
    """
    known = marks.marks
    judged = [np.array(mark.points) for mark in (*known.marks, *known.dropped)]
    stated = survey.hot_places, survey.cold_places
    counts = [PROPOSED if count is None else count for count in stated]
    most = CANDIDATES * max(counts)
    surveyed = replace(scene, train=scene.survey_views(THERMAL))
    found = find_spots(surveyed.views, regions.render, most, scene.reach, judged)
    chosen = [
        _standing_out(spots[: CANDIDATES * count], count, marks, surveyed, regions)
        for spots, count in zip(found, counts, strict=True)
    ]
    anomalies = [each for kept, _ in chosen for each in kept]
    hot, cold = ([each.reading.mark for each in kept] for kept, _ in chosen)
    proposals = marks.store.edit(lambda now: now.proposing({"H": hot, "C": cold})).proposals
    named = {
        mark.name: each._replace(reading=replace(each.reading, mark=mark))
        for mark, each in zip(proposals, anomalies, strict=True)
    }
    return Proposals(named, sum(held_back for _, held_back in chosen))


def _standing_out(
    spots: Sequence[Spot], count: int, marks: RunMarks, scene: Scene, regions: Regions
) -> tuple[list[Anomaly], int]:
    """The ``count`` spots that stand out most certainly, and how many do not; without those that
    too few photos see as a mark, such as what floats beside an outline."""
    least = min(LEAST_PHOTOS, len(scene.train_photos(THERMAL)))
    found = []
    for spot in spots:
        view = scene.views[spot.view]  # that shows it best
        camera = view.images[THERMAL].camera
        place, eye = places_of([spot.position.tolist(), camera.position.tolist()])
        mark = Mark("?", "spot", (place,), eye, spot_radius(place, camera, scene))
        rendering = regions.render(camera)
        contrast = spot.value - surroundings(view, spot, rendering)
        span = 1.0 if scene.temperature is None else scene.temperature.span_c
        found.append(Anomaly(spot, marks.meter.read(mark, regions), span * contrast))
    seen = [each for each in found if (each.reading.photos or 0) >= least]
    kept = sorted((each for each in seen if each.stands_out), key=lambda each: -each.certainty)
    return kept[:count], len(seen) - len(kept)
