"""Triangle meshes made of a few formulas: boxes, lathed and swept surfaces; metres, z up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

BOX_FACES = ("top", "bottom", "front", "back", "left", "right")


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh with smooth normals; vertices are duplicated where a crease or a texture seam
    runs.

    Attributes:
        vertices: positions, [V, 3].
        normals: unit vectors that point outwards, [V, 3].
        uv: texture coordinates, u to the right and v upwards in the texture image, [V, 2].
        faces: indices of the corners, counter-clockwise seen from outside, [F, 3].
    """

    vertices: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    uv: Float[np.ndarray, "v 2"]
    faces: Int[np.ndarray, "f 3"]

    def placed(self, x: float, y: float, z: float, yaw_deg: float = 0.0) -> Mesh:
        """The mesh turned about the z axis and then moved."""
        rotation = rotation_z(yaw_deg)
        vertices = self.vertices @ rotation.T + np.array([x, y, z])
        return Mesh(vertices, self.normals @ rotation.T, self.uv, self.faces)

    def inside_out(self) -> Mesh:
        """The same surface seen from its other side, as a room is."""
        return Mesh(self.vertices, -self.normals, self.uv, self.faces[:, ::-1])


def rotation_z(yaw_deg: float) -> Float[np.ndarray, "3 3"]:
    """Rotation about the z axis, counter-clockwise seen from above."""
    cos, sin = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
    )


def grid_mesh(
    points: Float[np.ndarray, "r c 3"],
    normals: Float[np.ndarray, "r c 3"],
    uv: Float[np.ndarray, "r c 2"],
) -> Mesh:
    """Triangulate a grid of points; with columns to the right and rows upwards it faces the
    viewer."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate(
        [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    )
    vertices = points.reshape(-1, 3)
    corners = vertices[faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    faces = faces[area > 1e-12]  # a row that lies on the axis of a lathed surface is a single point
    return Mesh(vertices, normals.reshape(-1, 3), uv.reshape(-1, 2), faces)


def box_faces(length: float, width: float, height: float) -> dict[str, Mesh]:
    """The six sides of a box that stands on z = 0, centred in x and y; each carries the whole
    texture once.

    Args:
        length: size along x, metres.
        width: size along y, metres.
        height: size along z, metres.
    """
    x, y, z = length / 2, width / 2, height
    corners = {  # lower left, lower right, upper right, upper left, seen from outside
        "top": [(-x, -y, z), (x, -y, z), (x, y, z), (-x, y, z)],
        "bottom": [(-x, y, 0), (x, y, 0), (x, -y, 0), (-x, -y, 0)],
        "front": [(-x, -y, 0), (x, -y, 0), (x, -y, z), (-x, -y, z)],
        "back": [(x, y, 0), (-x, y, 0), (-x, y, z), (x, y, z)],
        "left": [(-x, y, 0), (-x, -y, 0), (-x, -y, z), (-x, y, z)],
        "right": [(x, -y, 0), (x, y, 0), (x, y, z), (x, -y, z)],
    }
    return {name: quad(np.array(corners[name], dtype=np.float64)) for name in BOX_FACES}


def without(faces: Mapping[str, Mesh], name: str) -> Mesh:
    """All sides of a box but one, as one mesh."""
    return merge([mesh for side, mesh in faces.items() if side != name])


def box(length: float, width: float, height: float) -> Mesh:
    """A closed box that stands on z = 0, centred in x and y."""
    return merge(list(box_faces(length, width, height).values()))


def quad(corners: Float[np.ndarray, "4 3"]) -> Mesh:
    """A flat quadrilateral that carries the whole texture: lower left, lower right, upper right,
    upper left corner."""
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    points = np.stack([corners[[0, 1]], corners[[3, 2]]])
    uv = np.array([[[0.0, 0.0], [1.0, 0.0]], [[0.0, 1.0], [1.0, 1.0]]])
    return grid_mesh(points, np.broadcast_to(normal / np.linalg.norm(normal), points.shape), uv)


def lathe(*profile: Sequence[tuple[float, float]], segments: int = 64) -> Mesh:
    """Turn a profile about the z axis. u runs once around, v along the profile from 0 to 1.

    Args:
        profile: smooth pieces, one after the other, of (radius, height) in metres; a crease runs
            between two pieces. The outside lies to the right of the direction of travel: bottom,
            then upwards, then inwards over the top.
        segments: number of sides around the axis.
    """
    pieces = [np.array(piece, dtype=np.float64) for piece in profile]
    lengths = [
        np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
        for p in pieces
    ]
    total = sum(length[-1] for length in lengths)
    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    around[-1] = around[0]
    meshes, start = [], 0.0
    for piece, length in zip(pieces, lengths, strict=True):
        tangent = np.gradient(piece, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        u, v = np.meshgrid(angle / (2.0 * np.pi), (start + length) / total)
        points, normals = (
            _revolve(piece, around),
            _revolve(np.stack([tangent[:, 1], -tangent[:, 0]], -1), around),
        )
        meshes.append(grid_mesh(points, normals, np.stack([u, v], axis=-1)))
        start += length[-1]
    return merge(meshes)


def _revolve(
    profile: Float[np.ndarray, "r 2"], around: Float[np.ndarray, "c 2"]
) -> Float[np.ndarray, "r c 3"]:
    horizontal = profile[:, None, :1] * around[None]
    return np.concatenate(
        [horizontal, np.broadcast_to(profile[:, None, 1:], (*horizontal.shape[:2], 1))], axis=-1
    )


def sphere(radius: float, segments: int = 64) -> Mesh:
    """A sphere that rests on z = 0."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    profile = np.stack([radius * np.cos(angle), radius * (1.0 + np.sin(angle))], axis=-1)
    profile[[0, -1], 0] = 0.0
    return lathe([(float(r), float(z)) for r, z in profile], segments=segments)


def tube(path: Float[np.ndarray, "n 3"], radius: float, segments: int = 20) -> Mesh:
    """A round rod along a curve, closed by flat ends; u runs around, v along it.

    Args:
        path: points of the curve in metres, two or more, without a cusp.
        radius: radius of the rod, metres.
        segments: number of sides.
    """
    tangents = np.gradient(path, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    frames = _transported_frames(tangents)
    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    circle[-1] = circle[0]
    normals = np.einsum("ck,nkd->ncd", circle, frames)
    rings = path[:, None, :] + radius * normals
    u, v = np.meshgrid(angle / (2.0 * np.pi), np.linspace(0.0, 1.0, len(path)))
    uv = np.stack([u, v], axis=-1)
    side = grid_mesh(rings, normals, uv)
    return merge(
        [side, _cap(rings[0], path[0], -tangents[0]), _cap(rings[-1][::-1], path[-1], tangents[-1])]
    )


def _transported_frames(tangents: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 3"]:
    """Two normals per point of a curve that turn as little as possible from one point to the
    next."""
    axis = np.eye(3)[np.argmin(np.abs(tangents[0]))]
    frames = []
    for tangent in tangents:
        first = axis - tangent * (axis @ tangent)
        first /= np.linalg.norm(first)
        frames.append(np.stack([first, np.cross(tangent, first)]))
        axis = first
    return np.array(frames)


def _cap(
    ring: Float[np.ndarray, "c 3"], centre: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"]
) -> Mesh:
    points = np.stack([np.broadcast_to(centre, ring.shape), ring])
    return grid_mesh(
        points, np.broadcast_to(normal, points.shape), np.zeros((*points.shape[:2], 2))
    )
