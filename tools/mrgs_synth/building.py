"""Meshes for generated scenes with walls, roofs and vehicles: pierced walls, prisms, frames;
metres, z up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from mrgs_synth.shapes import Mesh, box, grid_mesh, merge, quad, tube


@dataclass(frozen=True)
class Opening:
    """A window or a door in a wall.

    Attributes:
        name: unique in the wall.
        x: its centre along the wall, metres.
        z: its lower edge above the ground, metres.
        width: metres.
        height: metres.
    """

    name: str
    x: float
    z: float
    width: float
    height: float

    @property
    def left(self) -> float:
        """Its edge at the smaller x."""
        return self.x - self.width / 2

    @property
    def right(self) -> float:
        """Its edge at the larger x."""
        return self.x + self.width / 2

    @property
    def top(self) -> float:
        """Its upper edge."""
        return self.z + self.height


def pierced_wall(length: float, height: float, openings: Sequence[Opening]) -> Mesh:
    """A wall in the plane y = 0 that faces −y, x from −length/2 to length/2, with one texture over
    all of it."""
    edges_x = sorted(
        {-length / 2, length / 2, *(o.left for o in openings), *(o.right for o in openings)}
    )
    edges_z = sorted({0.0, height, *(o.z for o in openings), *(o.top for o in openings)})
    cells = []
    for left, right in pairwise(edges_x):
        for bottom, top in pairwise(edges_z):
            x, z = (left + right) / 2, (bottom + top) / 2
            if not any(o.left < x < o.right and o.z < z < o.top for o in openings):
                cells.append(_upright(left, right, bottom, top, length, height))
    return merge(cells)


def _upright(
    left: float, right: float, bottom: float, top: float, length: float, height: float
) -> Mesh:
    x, z = np.meshgrid([left, right], [bottom, top])
    points = np.stack([x, 0.0 * x, z], axis=-1)
    uv = np.stack([x / length + 0.5, z / height], axis=-1)
    return grid_mesh(points, np.broadcast_to(np.array([0.0, -1.0, 0.0]), points.shape), uv)


def reveal(opening: Opening, depth: float) -> Mesh:
    """The four sides of an opening, from the wall's face at y = 0 to y = depth, seen from within
    the opening."""
    left, right, bottom, top = opening.left, opening.right, opening.z, opening.top
    near, far = 0.0, depth
    return merge(
        [
            quad(
                np.array(
                    [(left, near, bottom), (left, far, bottom), (left, far, top), (left, near, top)]
                )
            ),
            quad(
                np.array(
                    [
                        (right, far, bottom),
                        (right, near, bottom),
                        (right, near, top),
                        (right, far, top),
                    ]
                )
            ),
            quad(
                np.array(
                    [
                        (left, near, bottom),
                        (right, near, bottom),
                        (right, far, bottom),
                        (left, far, bottom),
                    ]
                )
            ),
            quad(
                np.array(
                    [(left, far, top), (right, far, top), (right, near, top), (left, near, top)]
                )
            ),
        ]
    )


def window_frame(
    opening: Opening, depth: float, bars: tuple[int, int], width: float = 0.08
) -> Mesh:
    """A frame of square beams around an opening, with bars between ``bars`` (columns, rows) of
    panes.

    Args:
        opening: where it stands.
        depth: y of its front, metres.
        bars: number of panes along x and along z.
        width: of its beams, metres; the bars are 0.7 times as wide.
    """
    thin = 0.7 * width
    beams = [
        (opening.left, opening.left + width, opening.z, opening.top),
        (opening.right - width, opening.right, opening.z, opening.top),
        (opening.left + width, opening.right - width, opening.z, opening.z + width),
        (opening.left + width, opening.right - width, opening.top - width, opening.top),
    ]
    inner = (opening.left + width, opening.right - width, opening.z + width, opening.top - width)
    columns = np.linspace(opening.left, opening.right, bars[0] + 1)[1:-1]
    rows = np.linspace(opening.z, opening.top, bars[1] + 1)[1:-1]
    beams += [(x - thin / 2, x + thin / 2, inner[2], inner[3]) for x in columns]
    beams += [(inner[0], inner[1], z - thin / 2, z + thin / 2) for z in rows]
    return merge(
        [beam(left, right, depth, depth + width, bottom, top) for left, right, bottom, top in beams]
    )


def beam(left: float, right: float, near: float, far: float, bottom: float, top: float) -> Mesh:
    """A box between two values of each coordinate: x, then y, then z."""
    middle = ((left + right) / 2, (near + far) / 2)
    return box(right - left, far - near, top - bottom).placed(middle[0], middle[1], bottom)


def prism(outline: Float[np.ndarray, "n 2"], length: float) -> Mesh:
    """A closed solid between two equal outlines at y = ±length/2.

    Args:
        outline: (x, z) of the corners in metres, counter-clockwise seen from −y;
            every corner can be seen from their mean.
        length: size along y, metres.
    """
    half = length / 2
    sides = []
    for (x0, z0), (x1, z1) in pairwise([*outline, outline[0]]):
        sides.append(
            quad(np.array([(x0, -half, z0), (x0, half, z0), (x1, half, z1), (x1, -half, z1)]))
        )
    front = _fan(outline, -half, np.array([0.0, -1.0, 0.0]))
    back = _fan(outline[::-1], half, np.array([0.0, 1.0, 0.0]))
    return merge([*sides, front, back])


def _fan(outline: Float[np.ndarray, "n 2"], y: float, normal: Float[np.ndarray, "3"]) -> Mesh:
    """A flat cap; the texture lies over its bounding box."""
    corners = np.concatenate([outline.mean(axis=0, keepdims=True), outline])
    low, size = corners.min(axis=0), np.ptp(corners, axis=0)
    uv = (corners - low) / size
    if normal[1] > 0:
        uv[:, 0] = 1.0 - uv[:, 0]
    index = np.arange(1, len(corners))
    faces = np.stack([np.zeros_like(index), index, np.roll(index, -1)], axis=-1)
    vertices = np.stack([corners[:, 0], np.full(len(corners), y), corners[:, 1]], axis=-1)
    return Mesh(vertices, np.broadcast_to(normal, vertices.shape), uv, faces)


def frustum(
    bottom: tuple[float, float], top: tuple[float, float], height: float, shift: float = 0.0
) -> Mesh:
    """A box on z = 0 whose upper side is smaller or larger than its lower side, and moved along x.

    Args:
        bottom: size of the lower side along x and y, metres.
        top: size of the upper side along x and y, metres.
        height: metres.
        shift: x of the centre of the upper side, metres.
    """
    (a, b), (c, d) = (bottom[0] / 2, bottom[1] / 2), (top[0] / 2, top[1] / 2)
    low = np.array([(-a, -b, 0.0), (a, -b, 0.0), (a, b, 0.0), (-a, b, 0.0)])
    high = np.array(
        [
            (shift - c, -d, height),
            (shift + c, -d, height),
            (shift + c, d, height),
            (shift - c, d, height),
        ]
    )
    sides = [
        quad(np.stack([low[i], low[(i + 1) % 4], high[(i + 1) % 4], high[i]])) for i in range(4)
    ]
    return merge([*sides, quad(high), quad(low[[1, 0, 3, 2]])])


def pane(opening: Opening, y: float) -> Mesh:
    """A flat rectangle that fills an opening at a depth of y metres, with one texture over all of
    it."""
    left, right, bottom, top = opening.left, opening.right, opening.z, opening.top
    return quad(np.array([(left, y, bottom), (right, y, bottom), (right, y, top), (left, y, top)]))


def rod(start: Sequence[float], end: Sequence[float], radius: float, segments: int = 12) -> Mesh:
    """A straight round rod, closed by flat ends."""
    return tube(np.array([start, end], dtype=np.float64), radius, segments)
