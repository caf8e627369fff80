"""The hottest and the coldest spots of a model: surfaces that several views agree on, never single
splats.

A splat's own temperature means little, because neighbours make up for each other, and a floater
before one camera can be of any temperature. So the spots are read from renderings, as a
thermographer reads them from photos:

1. Every view's thermal camera is rendered. Pixels that show a surface (accumulated alpha at least
  0.9) whose depth
   does not jump within 3×3 pixels become points in the scene.
2. The points are gathered in cubes of the size of 3×3 pixels, the usual spot of a spot meter. A
  view's value of a cube
   is the mean of its points there.
3. Cubes that fewer than three views see (all of them, where there are fewer) are left out. The
  value of the others is
   the median over the views: a reflection that few views catch does not count.
4. The extreme cubes are taken one by one, each at least 15 cube edges from those before it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64

from mrgs.scene import THERMAL, Camera, Reach, Rendering, View, evenly_spaced

VIEWS = 60
"""Number of views that are surveyed, evenly spaced over those given."""

WIDTH_PX = 320
SURFACE_ALPHA = 0.9
DEPTH_JUMP = 0.1
"""Relative difference of depth within 3×3 pixels above which a pixel counts as an edge."""

CUBE_PX = 3
MIN_POINTS = 3
"""Of one view in a cube; fewer are a sliver seen at a grazing angle."""

MIN_VIEWS = 3
SEPARATION_CUBES = 15

Renderer = Callable[[Camera], Rendering]
"""Renders the thermal image of a camera."""


class Spot(NamedTuple):
    """A spot on a surface.

    Attributes:
        position: in world coordinates, scene units, [3].
        value: normalised temperature, the median over the views that see it.
        low: 10th percentile of these views' values, normalised.
        high: 90th percentile of these views' values, normalised.
        views: how many views see it.
        view: index of the view that shows it best (most pixels, away from the border).
    """

    position: Float[np.ndarray, "3"]
    value: float
    low: float
    high: float
    views: int
    view: int


class _Points(NamedTuple):
    """Surface points of all views.

    Attributes:
        positions: [P, 3], scene units.
        values: normalised temperatures, [P].
        views: index of the view of each, [P].
        central: whether the pixel is away from the image's border, [P].
        footprint: median distance between neighbouring pixels on the surfaces, scene units.
    """

    positions: Float[np.ndarray, "p 3"]
    values: Float[np.ndarray, " p"]
    views: Int64[np.ndarray, " p"]
    central: Bool[np.ndarray, " p"]
    footprint: float


class _Sightings(NamedTuple):
    """The S values that views have in cubes, sorted by cube.

    Attributes:
        cubes: index of the cube, 0 to C − 1, [S].
        views: [S].
        values: mean of the view's points in the cube, [S].
        positions: their mean, [S, 3].
        points: how many, 0 if they touch the border, [S].
    """

    cubes: Int64[np.ndarray, " s"]
    views: Int64[np.ndarray, " s"]
    values: Float[np.ndarray, " s"]
    positions: Float[np.ndarray, "s 3"]
    points: Int64[np.ndarray, " s"]


class _Cube(NamedTuple):
    """The values of all views in one cube.

    Attributes:
        median: of the values.
        values: one per view, ascending, [V].
        rows: the sightings that they come from, [V].
    """

    median: float
    values: Float[np.ndarray, " v"]
    rows: Int64[np.ndarray, " v"]


def find_spots(
    views: Sequence[View], render: Renderer, count: int = 3, ball: Reach | None = None
) -> tuple[list[Spot], list[Spot]]:
    """The hottest and the coldest spots, at most ``count`` of each, the most extreme first.

    Args:
        views: of the capture; those without a thermal image are skipped.
        render: renders the thermal image of a camera.
        count: largest number of spots in each list.
        ball: how far the scene reaches; the sky beyond it is no spot. None if there is none.
    """
    thermal = [index for index, view in enumerate(views) if THERMAL in view.images]
    chosen = [thermal[place] for place in evenly_spaced(len(thermal), VIEWS)]
    points = _survey(views, chosen, render, ball)
    if points is None:
        return [], []
    sightings, edge = _sightings(points)
    cubes = _agreed(sightings, min(MIN_VIEWS, len(chosen)))
    hottest, coldest = (
        _apart(row, sightings, count, SEPARATION_CUBES * edge) for row in (cubes[::-1], cubes)
    )
    return hottest, coldest


def _survey(
    views: Sequence[View], chosen: Sequence[int], render: Renderer, ball: Reach | None
) -> _Points | None:
    """Step 1: the surface points of the chosen views; None if there are none."""
    parts = []
    for index in chosen:
        camera = views[index].images[THERMAL].camera
        camera = camera.with_width(min(WIDTH_PX, camera.width))
        rendering = render(camera)
        surface = rendering.surface_depth(THERMAL, SURFACE_ALPHA, DEPTH_JUMP).double()
        depth_map = (surface if ball is None else ball.without_background(camera, surface)).numpy()
        rows, columns = np.nonzero(np.isfinite(depth_map))
        values = rendering[THERMAL].image[..., 0].numpy()[rows, columns]
        depth = depth_map[rows, columns]
        border = 0.1 * min(camera.width, camera.height)
        central = (np.minimum(columns, camera.width - columns) > border) & (
            np.minimum(rows, camera.height - rows) > border
        )
        footprint = depth / camera.K[0, 0].item()
        pixels = torch.from_numpy(np.stack([columns, rows], axis=1) + 0.5)
        positions = camera.unproject(pixels, torch.from_numpy(depth)).numpy()
        parts.append((positions, values, np.full(len(rows), index), central, footprint))
    if not sum(len(part[0]) for part in parts):
        return None
    positions, values, owners, central, footprints = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    return _Points(positions, values, owners, central, float(np.median(footprints)))


def _sightings(points: _Points) -> tuple[_Sightings, float]:
    """Step 2, and the edge of the cubes in scene units."""
    edge = CUBE_PX * points.footprint
    cells = np.floor(points.positions / edge).astype(np.int64)
    _, cubes = np.unique(cells, axis=0, return_inverse=True)
    order = np.lexsort((points.views, cubes.reshape(-1)))
    cubes, views = cubes.reshape(-1)[order], points.views[order]
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
    return [
        _Cube(
            medians[i],
            values[starts[i] : starts[i] + numbers[i]],
            order[starts[i] : starts[i] + numbers[i]],
        )
        for i in enough[np.argsort(medians[enough], kind="stable")]
    ]


def _apart(
    cubes: Iterable[_Cube], sightings: _Sightings, count: int, distance: float
) -> list[Spot]:
    """Step 4: the first cubes of the list that keep the distance from each other."""
    kept: list[Spot] = []
    for cube in cubes:
        position = np.median(sightings.positions[cube.rows], axis=0)
        if any(np.linalg.norm(position - other.position) < distance for other in kept):
            continue
        low, high = np.quantile(cube.values, [0.1, 0.9])
        best = cube.rows[np.argmax(sightings.points[cube.rows])]
        kept.append(
            Spot(
                position,
                float(cube.median),
                float(low),
                float(high),
                len(cube.rows),
                int(sightings.views[best]),
            )
        )
        if len(kept) == count:
            break
    return kept
