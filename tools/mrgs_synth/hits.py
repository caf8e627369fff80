"""Where the rays of a camera first meet a surface: the exact geometry behind depth and
temperature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from mrgs.scene import Camera
from mrgs_synth.boxtree import BoxTree
from mrgs_synth.stage import Solid

NEAR_M = 1e-3


@dataclass(frozen=True, eq=False)
class Triangles:
    """All triangles of a stage: corners in world coordinates [F, 3, 3], the unit normals and the
    texture coordinates there, and the index of each one's solid [F]."""

    corners: Float[np.ndarray, "f 3 3"]
    normals: Float[np.ndarray, "f 3 3"]
    uv: Float[np.ndarray, "f 3 2"]
    solid: Int[np.ndarray, " f"]

    @classmethod
    def of(cls, solids: Sequence[Solid]) -> Triangles:
        """Collect the triangles of solids in world coordinates."""
        meshes = [solid.world_mesh() for solid in solids]
        counts = [len(mesh.faces) for mesh in meshes]
        corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
        normals = np.concatenate([mesh.normals[mesh.faces] for mesh in meshes])
        uv = np.concatenate([mesh.uv[mesh.faces] for mesh in meshes])
        return cls(corners, normals, uv, np.repeat(np.arange(len(meshes)), counts))

    def weights(
        self, triangle: Int[np.ndarray, " n"], points: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """Barycentric coordinates of points of triangles."""
        a, b, c = (self.corners[triangle, corner] for corner in range(3))
        flat = np.cross(b - a, c - a)
        area = (flat * flat).sum(axis=1)
        weight_b = (np.cross(points - a, c - a) * flat).sum(axis=1) / area
        weight_c = (np.cross(b - a, points - a) * flat).sum(axis=1) / area
        return np.stack([1.0 - weight_b - weight_c, weight_b, weight_c], axis=1)

    @cached_property
    def tree(self) -> BoxTree:
        """For rays that do not start at a camera."""
        return BoxTree.of(self.corners)


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of a grid of rays.

    Attributes:
        depth_m: z-depth, [H, W]; 0 where a ray meets nothing.
        triangle: index of the triangle, [H, W]; −1 where a ray meets nothing.
        solid: index of the solid, [H, W]; −1 where a ray meets nothing.
        points: world coordinates of the hits, [H, W, 3].
    """

    depth_m: Float[np.ndarray, "h w"]
    triangle: Int[np.ndarray, "h w"]
    solid: Int[np.ndarray, "h w"]
    points: Float[np.ndarray, "h w 3"]


def first_hits(camera: Camera, triangles: Triangles) -> Hits:
    """Follow the ray through the centre of each pixel to the first surface, seen from either
    side."""
    rotation, translation = camera.viewmat[:3, :3].numpy(), camera.viewmat[:3, 3].numpy()
    corners = triangles.corners @ rotation.T + translation
    x, y = _ray_slopes(camera)
    depth = np.full((camera.height, camera.width), np.inf)
    nearest = np.full((camera.height, camera.width), -1)
    _nearest_triangles(corners, x, y, depth, nearest)
    missed = nearest < 0
    depth[missed] = 0.0
    rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1)
    points = (rays * depth[..., None] - translation) @ rotation
    return Hits(depth, nearest, np.where(missed, -1, triangles.solid[nearest]), points)


def _ray_slopes(camera: Camera) -> tuple[Float[np.ndarray, " w"], Float[np.ndarray, " h"]]:
    """x and y of the rays (x, y, 1) through the centres of the columns and rows, in camera
    coordinates."""
    K = camera.K.numpy()
    x = (np.arange(camera.width) + 0.5 - K[0, 2]) / K[0, 0]
    y = (np.arange(camera.height) + 0.5 - K[1, 2]) / K[1, 1]
    return x, y


def ray_directions(camera: Camera) -> Float[np.ndarray, "h w 3"]:
    """Unit vectors, in the world, from the camera through the centres of its pixels."""
    x, y = _ray_slopes(camera)
    rays = (
        np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1)
        @ camera.viewmat[:3, :3].numpy()
    )
    directions: Float[np.ndarray, "h w 3"] = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return directions


@njit(cache=True)
@no_type_check
def _nearest_triangles(
    corners: np.ndarray, x: np.ndarray, y: np.ndarray, depth: np.ndarray, nearest: np.ndarray
) -> None:
    """Keep the nearest hit of the rays (x, y, 1), homogeneous rasterisation: triangles need not lie
    before the camera.

    With a, b, c the corners in camera coordinates, a ray d meets the triangle where d·(b×c),
    d·(c×a) and d·(a×b) have one sign, at the depth a·(b×c) over their sum.
    """
    for f in range(corners.shape[0]):
        a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
        bc, ca, ab = np.cross(b, c), np.cross(c, a), np.cross(a, b)
        volume = a[0] * bc[0] + a[1] * bc[1] + a[2] * bc[2]
        left, right, upper, lower = _bounds(corners[f], x, y)
        for row in range(upper, lower):
            for column in range(left, right):
                wa = x[column] * bc[0] + y[row] * bc[1] + bc[2]
                wb = x[column] * ca[0] + y[row] * ca[1] + ca[2]
                wc = x[column] * ab[0] + y[row] * ab[1] + ab[2]
                if (wa >= 0.0 and wb >= 0.0 and wc >= 0.0) or (
                    wa <= 0.0 and wb <= 0.0 and wc <= 0.0
                ):
                    total = wa + wb + wc
                    if total != 0.0 and NEAR_M < volume / total < depth[row, column]:
                        depth[row, column] = volume / total
                        nearest[row, column] = f


@njit(cache=True)
@no_type_check
def _bounds(corners: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[int, int, int, int]:
    """Columns and rows of the rays that may meet a triangle: all of them where a corner lies behind
    the camera."""
    if corners[:, 2].min() <= NEAR_M:
        return 0, len(x), 0, len(y)
    u, v = corners[:, 0] / corners[:, 2], corners[:, 1] / corners[:, 2]
    left, right = np.searchsorted(x, u.min()), np.searchsorted(x, u.max(), side="right")
    upper, lower = np.searchsorted(y, v.min()), np.searchsorted(y, v.max(), side="right")
    return left, right, upper, lower
