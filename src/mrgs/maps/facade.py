"""The map of a façade from the front.

The façade is the upright plane with most of the surfaces that photos show: random sample consensus
over single points with their normals (Fischler and Bolles, 1981), then a least-squares line in plan
view.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import scipy.ndimage
import torch
from jaxtyping import Bool, Float64

from mrgs.errors import RunError
from mrgs.maps.options import MapOptions
from mrgs.maps.surfaces import MapGrid, pixel_size_m, up_direction, vertical
from mrgs.scene import Scene
from mrgs.scene.depth_map import MAX_STEP, DepthMap

Vector: TypeAlias = Float64[np.ndarray, "3"]

SAMPLES = 60_000
CANDIDATES = 400
REFITS = 4

BASELINE_PX = 4
"""Side, in pixels, of the triangles that give the normals: depths jump from splat to splat."""

THICKNESS = 0.012
"""A point this share of the median viewing distance off a plane still belongs to it: window reveals
and the noise of depths do."""

MAX_TURN = 0.5
"""Largest sine of the angle between the normals of a plane and of a point on it; also between a
wall's normal and the horizontal."""

MIN_SHARE = 0.1
"""A façade takes up at least this share of what the photos show of surfaces."""

CELLS = 64
"""Cells along the longer side of a façade in which its outline is found."""

RELIEF = 0.2
"""What is before the plane, or behind it, by more than this share of the façade's
shorter side is not drawn: trees, cars, the roof."""

_MARGIN = 0.02
_TRIMMED_PERCENT = 0.2


class Facade(NamedTuple):
    """A façade: right, up and out of the wall as rows, unit length, and the smallest and largest
    coordinates along them of what belongs to it."""

    axes: Float64[np.ndarray, "3 3"]
    low: Vector
    high: Vector


class Surfaces(NamedTuple):
    """Points on surfaces that photos show, with normals of unit length towards the camera, and
    their median distance from the cameras, scene units."""

    points: Float64[np.ndarray, "n 3"]
    normals: Float64[np.ndarray, "n 3"]
    distance: float


def find_facade(surfaces: Surfaces, up: Vector, eye: Vector) -> Facade:
    """The façade of a scene, with the vertical ``up`` of unit length, seen from ``eye`` before it;
    RunError if no upright plane has ``MIN_SHARE`` of the surfaces."""
    walls = np.abs(surfaces.normals @ up) < MAX_TURN
    normal, anchor = _upright_plane(surfaces, walls, up)
    members = _members(surfaces, normal, anchor)
    share = members.mean()
    if share < MIN_SHARE:
        raise RunError(
            f"no façade was found: the largest upright plane has {100 * share:.0f} % of the "
            f"surfaces that the photos show; give three of its points",
            options=("plane",),
        )
    return _outlined(surfaces.points[members], normal, anchor, up, eye)


def given_facade(
    surfaces: Surfaces, corners: Float64[np.ndarray, "3 3"], up: Vector | None, eye: Vector
) -> Facade:
    """The façade through three points: lower left, lower right, and one above them. The vertical,
    where it is known and not across the plane, decides where its top is; else the points do.
    RunError if no surface that photos show is on the plane."""
    across, aside = corners[1] - corners[0], corners[2] - corners[0]
    normal = np.cross(across, aside)
    normal /= np.linalg.norm(normal)
    upwards = aside - across * (aside @ across) / (across @ across)
    if up is not None and abs(up @ normal) < MAX_TURN:
        upwards = up
    members = _members(surfaces, normal, corners[0])
    if not members.any():
        raise RunError(
            "no surface that the photos show lies on the plane of the three points; check the "
            "points",
            options=("plane",),
        )
    return _outlined(surfaces.points[members], normal, corners[0], upwards, eye)


NO_FACADE = "no façade was found: the photos show no wall; give three of its points"


def surfaces_of(maps: Sequence[DepthMap]) -> Surfaces:
    """Points with normals from depth maps, thinned evenly to ``SAMPLES``; RunError for none."""
    parts = [_surfaces(item) for item in maps]
    points, normals, depths = (np.concatenate([part[k] for part in parts]) for k in range(3))
    if not len(points):
        raise RunError(NO_FACADE, options=("plane",))
    chosen = np.random.default_rng(0).permutation(len(points))[:SAMPLES]
    distance = float(np.median(depths))
    return Surfaces(points[chosen], normals[chosen], distance)


def _surfaces(item: DepthMap) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals and depths of the pixels whose neighbours lie on the same surface."""
    depth = np.where(np.isfinite(item.depth), item.depth, np.nan).astype(np.float64)
    points = item.camera.unproject_image(torch.from_numpy(depth)).numpy()
    s = BASELINE_PX
    here, right, below = points[:-s, :-s], points[:-s, s:], points[s:, :-s]
    spanned = np.cross(below - here, right - here)
    area = np.linalg.norm(spanned, axis=2)
    z = depth[:-s, :-s]
    steps = np.maximum(np.abs(depth[:-s, s:] - z), np.abs(depth[s:, :-s] - z))
    with np.errstate(invalid="ignore"):
        smooth = (steps < MAX_STEP * z) & (area > 0)
    towards = item.camera.position.numpy() - here[smooth]
    normals = spanned[smooth] / area[smooth][:, None]
    normals *= np.sign((normals * towards).sum(axis=1, keepdims=True))
    return here[smooth], normals, z[smooth]


def _upright_plane(
    surfaces: Surfaces, walls: Bool[np.ndarray, " n"], up: Vector
) -> tuple[Vector, Vector]:
    """The normal of the upright plane with most of the surfaces, and a point on it."""
    rows = np.flatnonzero(walls)
    if not len(rows):
        raise RunError(NO_FACADE, options=("plane",))
    tried = np.random.default_rng(1).choice(rows, CANDIDATES)
    best, most = (np.zeros(3), np.zeros(3)), -1
    for row in tried:
        normal = surfaces.normals[row] - up * (surfaces.normals[row] @ up)
        plane = normal / np.linalg.norm(normal), surfaces.points[row]
        count = int(_members(surfaces, *plane).sum())
        if count > most:
            best, most = plane, count
    for _ in range(REFITS):
        members = _members(surfaces, *best)
        best = _fitted(surfaces.points[members], up, best[0])
    return best


def _fitted(
    points: Float64[np.ndarray, "n 3"], up: Vector, before: Vector
) -> tuple[Vector, Vector]:
    """The upright plane of least squares, its normal on the side of an earlier one."""
    middle = points.mean(axis=0)
    offsets = points - middle
    offsets -= np.outer(offsets @ up, up)  # plan view
    scatter = np.einsum("ni,nj->ij", offsets, offsets)
    _, vectors = np.linalg.eigh(scatter + 2 * np.trace(scatter) * np.outer(up, up))
    normal = vectors[:, 0]
    return normal * (np.sign(normal @ before) or 1.0), middle


def _members(surfaces: Surfaces, normal: Vector, anchor: Vector) -> Bool[np.ndarray, " n"]:
    near = np.abs((surfaces.points - anchor) @ normal) < THICKNESS * surfaces.distance
    return near & (np.abs(surfaces.normals @ normal) > np.sqrt(1 - MAX_TURN**2))


def _outlined(
    members: Float64[np.ndarray, "n 3"], normal: Vector, anchor: Vector, up: Vector, eye: Vector
) -> Facade:
    """The axes of a plane seen from ``eye``, and the extent of its largest connected part."""
    out = normal * (np.sign((eye - anchor) @ normal) or 1.0)
    upwards = up - out * (up @ out)
    upwards /= np.linalg.norm(upwards)
    axes = np.stack([np.cross(upwards, out), upwards, out])
    local = np.einsum("ij,nj->ni", axes, members)
    local = local[_largest_part(local[:, :2])]
    low, high = np.percentile(local, [_TRIMMED_PERCENT, 100 - _TRIMMED_PERCENT], axis=0)
    margin = _MARGIN * (high - low)[:2].max()
    relief = RELIEF * (high - low)[:2].min()
    plane = float(anchor @ out)
    return Facade(
        axes,
        np.array([*(low[:2] - margin), plane - relief]),
        np.array([*(high[:2] + margin), plane + relief]),
    )


def _largest_part(places: Float64[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """The points of the largest connected part of a plane, with gaps no wider than windows."""
    low, high = np.percentile(places, [1, 99], axis=0)
    cell = max(float((high - low).max()) / CELLS, 1e-9)
    inside = np.floor((places - places.min(axis=0)) / cell).astype(int)
    taken = np.zeros(inside.max(axis=0) + 1, bool)
    taken[tuple(inside.T)] = True
    parts, _ = scipy.ndimage.label(scipy.ndimage.binary_dilation(taken, iterations=2))
    labels = parts[tuple(inside.T)]
    return labels == np.bincount(labels).argmax()


def facade_grid(
    scene: Scene, maps: Sequence[DepthMap], options: MapOptions, most_px: int | None = None
) -> MapGrid:
    """The pixels of the map of a façade, by a ``survey``; ``options`` has plane and pixel size. For
    ``most_px`` see ``pixel_size_m``. ConfigError if up is not known, RunError without a façade."""
    surfaces = surfaces_of(maps)
    eye = torch.stack([item.camera.position for item in maps]).mean(dim=0).numpy()
    if options.plane is None:
        axes, low, high = find_facade(surfaces, vertical(scene), eye)
    else:
        axes, low, high = given_facade(surfaces, options.points, up_direction(scene), eye)
    pixel_m = pixel_size_m(scene, maps, options, (high - low)[:2], most_px)
    width, height = (max(int(np.ceil(size / pixel_m)), 1) for size in (high - low)[:2])
    offset: Float64[np.ndarray, "2"] = -low[:2]  # map coordinates begin at the lower left corner
    slab = float(low[2]), float(high[2])
    return MapGrid(axes, 1.0, offset, 0.0, height * pixel_m, pixel_m, width, height, slab)
