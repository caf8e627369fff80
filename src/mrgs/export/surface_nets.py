"""The zero level of a sampled distance field as triangles, by naive surface nets.

One vertex per cell that the surface crosses, at the mean of the crossings on its edges; one quad
per crossed edge of the grid (S. Gibson, "Constrained Elastic Surface Nets", 1998, without the
relaxation). Smoother than marching cubes on noisy fields, and without its tables.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int32, Int64

_CORNERS = np.array(list(product((0, 1), repeat=3)))
_EDGES = [
    (a, b)
    for a in range(8)
    for b in range(a + 1, 8)
    if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1
]


def surface_nets(
    values: Float[np.ndarray, "x y z"],
) -> tuple[Float[np.ndarray, "v 3"], Int32[np.ndarray, "f 3"]]:
    """Triangles of the level 0, seen counter-clockwise from the positive side.

    Args:
        values: signed distances, negative inside; NaN where nothing is known: no surface is drawn
            in cells that touch it.

    Returns:
        vertices in grid coordinates (sample (i, j, k) lies at i, j, k), and faces as rows of
        ``vertices``.
    """
    inside = values < 0
    active = _active_cells(inside, np.isfinite(values))
    cells = np.argwhere(active)
    index = np.full(active.shape, -1, dtype=np.int32)
    index[active] = np.arange(len(cells), dtype=np.int32)
    quads = [_quads(inside, index, axis) for axis in range(3)]
    faces = np.concatenate(
        [quad[:, corners] for quad in quads for corners in ((0, 1, 2), (0, 2, 3))]
    )
    return _vertices(values, cells), faces


def _active_cells(
    inside: Bool[np.ndarray, "x y z"], known: Bool[np.ndarray, "x y z"]
) -> Bool[np.ndarray, "x-1 y-1 z-1"]:
    """Cells whose eight corners are known and lie on both sides."""
    count = np.zeros([size - 1 for size in inside.shape], dtype=np.uint8)
    complete = np.ones(count.shape, dtype=bool)
    for corner in _CORNERS:
        here = tuple(
            slice(offset, offset + size) for offset, size in zip(corner, count.shape, strict=True)
        )
        count += inside[here]
        complete &= known[here]
    return complete & (count > 0) & (count < 8)


def _vertices(
    values: Float[np.ndarray, "x y z"], cells: Int64[np.ndarray, "c 3"]
) -> Float[np.ndarray, "c 3"]:
    """The mean of the points where the edges of each cell cross the level."""
    at_corners = np.stack([values[tuple((cells + corner).T)] for corner in _CORNERS], axis=1)
    total, count = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for a, b in _EDGES:
        first, second = at_corners[:, a], at_corners[:, b]
        crossed = (first < 0) != (second < 0)
        share = np.where(crossed, first, 0) / np.where(crossed, first - second, 1)
        total += crossed[:, None] * (_CORNERS[a] + share[:, None] * (_CORNERS[b] - _CORNERS[a]))
        count += crossed
    return cells + total / count[:, None]


def _quads(
    inside: Bool[np.ndarray, "x y z"], index: Int32[np.ndarray, "x-1 y-1 z-1"], axis: int
) -> Int32[np.ndarray, "q 4"]:
    """The quads around the crossed edges along an axis, with all four of their cells active."""
    along, u, v = np.roll(np.eye(3, dtype=np.int64), -axis, axis=0)
    ahead = np.roll(inside, -1, axis=axis)
    crossed = inside != ahead
    crossed[tuple(slice(-1, None) if i == axis else slice(None) for i in range(3))] = False
    start = np.argwhere(crossed)
    # The first and last samples across the axis have no cell on one side.
    across = [i for i in range(3) if i != axis]
    start = start[
        ((start[:, across] > 0) & (start[:, across] < np.array(index.shape)[across])).all(axis=1)
    ]
    around = np.stack([index[tuple((start - step).T)] for step in (u + v, v, 0 * along, u)], axis=1)
    outward = inside[tuple(start.T)]
    around = np.where(outward[:, None], around, around[:, ::-1])
    return around[(around >= 0).all(axis=1)]
