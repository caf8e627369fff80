"""First hits of rays that start anywhere: a tree of bounding boxes over triangles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

LEAF_TRIANGLES = 4
NEAREST_M = 1e-7
"""Rays miss what is nearer, such as the surface that they start from."""


@dataclass(frozen=True, eq=False)
class BoxTree:
    """A binary tree; the children of an inner node are ``first`` and ``first + 1``.

    Attributes:
        corners: of the triangles, sorted so that each leaf has a run of them, [F, 3, 3].
        order: the triangle's index before sorting, [F].
        low: lower corner of each node's box, [N, 3].
        high: upper corner of each node's box, [N, 3].
        first: first child of an inner node, first triangle of a leaf, [N].
        count: number of triangles of a leaf, 0 for an inner node, [N].
    """

    corners: Float[np.ndarray, "f 3 3"]
    order: Int[np.ndarray, " f"]
    low: Float[np.ndarray, "n 3"]
    high: Float[np.ndarray, "n 3"]
    first: Int[np.ndarray, " n"]
    count: Int[np.ndarray, " n"]

    @classmethod
    def of(cls, corners: Float[np.ndarray, "f 3 3"]) -> BoxTree:
        """Split the triangles at the median of their centres, along the longest side, again and
        again."""
        lower, upper, centres = corners.min(axis=1), corners.max(axis=1), corners.mean(axis=1)
        order = np.arange(len(corners))
        nodes, low, high = [[0, len(corners)]], [], []
        number = 0
        while number < len(nodes):
            start, count = nodes[number]
            inside = order[start : start + count]
            low.append(lower[inside].min(axis=0))
            high.append(upper[inside].max(axis=0))
            if count > LEAF_TRIANGLES:
                axis = int(np.argmax(np.ptp(centres[inside], axis=0)))
                half = count // 2
                sorting = np.argsort(centres[inside, axis], kind="stable")
                order[start : start + count] = inside[sorting]
                nodes[number] = [len(nodes), 0]
                nodes += [[start, half], [start + half, count - half]]
            number += 1
        table = np.array(nodes)
        return cls(corners[order], order, np.array(low), np.array(high), table[:, 0], table[:, 1])

    def cast(
        self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """Follow rays to the first triangle, seen from either side.

        Args:
            origins: where they start.
            directions: where they go; distances are in units of their length.

        Returns:
            Distances (infinite where a ray meets nothing) and indices of the triangles (−1 there).
        """
        distance = np.full(len(origins), np.inf)
        triangle = np.full(len(origins), -1)
        if len(origins):
            _cast(
                self.corners, self.low, self.high, self.first, self.count,
                np.ascontiguousarray(origins), np.ascontiguousarray(directions),
                distance, triangle,
            )  # fmt: skip
        return distance, np.where(triangle < 0, -1, self.order[triangle])


@njit(cache=True)
@no_type_check
def _cast(corners, low, high, first, count, origins, directions, distance, triangle) -> None:
    stack = np.empty(128, dtype=np.int64)
    for ray in range(len(origins)):
        origin, direction = origins[ray], directions[ray]
        stack[0], size = 0, 1
        while size > 0:
            size -= 1
            node = stack[size]
            if not _meets_box(origin, direction, low[node], high[node], distance[ray]):
                continue
            if count[node] == 0:
                stack[size], stack[size + 1] = first[node], first[node] + 1
                size += 2
                continue
            for f in range(first[node], first[node] + count[node]):
                t = _meets_triangle(origin, direction, corners[f])
                if NEAREST_M < t < distance[ray]:
                    distance[ray], triangle[ray] = t, f


@njit(cache=True)
@no_type_check
def _meets_box(origin, direction, low, high, limit) -> bool:
    near, far = 0.0, limit
    for axis in range(3):
        if direction[axis] == 0.0:
            if origin[axis] < low[axis] or origin[axis] > high[axis]:
                return False
            continue
        a = (low[axis] - origin[axis]) / direction[axis]
        b = (high[axis] - origin[axis]) / direction[axis]
        near, far = max(near, min(a, b)), min(far, max(a, b))
    return near <= far


@njit(cache=True)
@no_type_check
def _meets_triangle(origin, direction, corners) -> float:
    """The distance to a triangle (Möller and Trumbore); infinite if the ray misses it."""
    ax, ay, az = corners[0, 0], corners[0, 1], corners[0, 2]
    ux, uy, uz = corners[1, 0] - ax, corners[1, 1] - ay, corners[1, 2] - az
    vx, vy, vz = corners[2, 0] - ax, corners[2, 1] - ay, corners[2, 2] - az
    dx, dy, dz = direction[0], direction[1], direction[2]
    px, py, pz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
    determinant = ux * px + uy * py + uz * pz
    if determinant == 0.0:
        return np.inf
    sx, sy, sz = origin[0] - ax, origin[1] - ay, origin[2] - az
    u = (sx * px + sy * py + sz * pz) / determinant
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    v = (dx * qx + dy * qy + dz * qz) / determinant
    if u < 0.0 or v < 0.0 or u + v > 1.0:
        return np.inf
    return (vx * qx + vy * qy + vz * qz) / determinant
