"""Depth of the surfaces in a photo, from the sparse points of structure from motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial import ConvexHull, QhullError, cKDTree

from mrgs.scene import Camera

STEP_PX = 4
"""Photo pixels per value of the map; sparse points have no more detail."""

_BEND = 150.0
"""Curvature of the lifted surface: a hole of 5 % of the image's width, between points of a near
surface, is closed against points that are more than about 10 % farther away."""

_NEAR_SURFACE = 0.06
_NEIGHBOURS = 9
_OUTLIER = 0.1
_MOST_POINTS = 6000
FEWEST_POINTS = 8


@dataclass(frozen=True, eq=False)
class InverseDepth:
    """Inverse depth 1 / z over a photo; linear in the image over planes, and 0 at infinity.

    Attributes:
        values: one per ``STEP_PX`` photo pixels, in 1 / scene units, [rows, columns].
        median: of the points that the photo sees.
    """

    values: Float[np.ndarray, "rows columns"]
    median: float


def inverse_depth(
    points: Float[np.ndarray, "n 3"], camera: Camera, visible: Int[np.ndarray, " k"] | None = None
) -> InverseDepth | None:
    """The inverse depth of a photo, interpolated between the points that it sees; None if they are
    too few.

    Args:
        points: [N, 3], in world coordinates.
        camera: of the photo.
        visible: indices of the points that the photo sees; None to find hidden ones by their depth.
    """
    uv, inverse = _project(points if visible is None else points[visible], camera)
    if len(uv) < FEWEST_POINTS:
        return None
    if visible is None:
        uv, inverse = _unhidden(uv, inverse, camera.width)
    uv, inverse = _without_outliers(uv, inverse)
    if len(uv) < FEWEST_POINTS:
        return None
    every = -(-len(uv) // _MOST_POINTS)
    return InverseDepth(
        _interpolated(uv[::every], inverse[::every], camera), float(np.median(inverse))
    )


def _project(
    points: Float[np.ndarray, "n 3"], camera: Camera
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
    """Pixel positions and inverse depths of the points inside the image; of points at one position,
    one."""
    pixels, depth = camera.project(points)
    seen = camera.contains(pixels)
    uv, first = np.unique(pixels[seen].numpy(), axis=0, return_index=True)
    return uv, 1.0 / depth[seen].numpy()[first]


def _unhidden(
    uv: Float[np.ndarray, "n 2"], inverse: Float[np.ndarray, " n"], width: int
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
    """The points that no surface through nearer points hides.

    After the hidden-point removal of Katz, Tal and Basri (2007), in the image: inverse depth is
    lifted by a paraboloid, and what lies on the upper convex hull is visible. Points just under the
    surface through these are, too.
    """
    radius2 = ((uv / width) ** 2).sum(axis=1)
    lifted = np.column_stack([uv / width, inverse / np.quantile(inverse, 0.9) - _BEND * radius2])
    try:
        hull = ConvexHull(lifted)
    except QhullError:  # all in one plane: nothing hides anything
        return uv, inverse
    front = np.unique(hull.simplices[hull.equations[:, 2] > 0])
    surface = LinearNDInterpolator(uv[front], inverse[front])(uv)
    seen = np.abs(inverse - surface) < _NEAR_SURFACE * surface
    seen[front] = True
    return uv[seen], inverse[seen]


def _without_outliers(
    uv: Float[np.ndarray, "n 2"], inverse: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
    _, nearest = cKDTree(uv).query(uv, k=min(_NEIGHBOURS, len(uv)))
    usual = np.median(inverse[nearest], axis=1)
    kept = np.abs(inverse - usual) < _OUTLIER * usual
    return uv[kept], inverse[kept]


def _interpolated(
    uv: Float[np.ndarray, "n 2"], inverse: Float[np.ndarray, " n"], camera: Camera
) -> Float[np.ndarray, "rows columns"]:
    """Linear between the points, that of the nearest point beyond them."""
    grid = np.meshgrid(
        np.arange(STEP_PX / 2, camera.width, STEP_PX),
        np.arange(STEP_PX / 2, camera.height, STEP_PX),
    )
    values = NearestNDInterpolator(uv, inverse)(*grid)
    try:
        between = LinearNDInterpolator(uv, inverse)(*grid)
    except QhullError:  # all on one line
        return values
    return np.where(np.isnan(between), values, between)
