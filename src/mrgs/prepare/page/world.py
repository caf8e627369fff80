"""Cameras and points: data for the page's views of them in 3D, from above and from the side."""

from __future__ import annotations

import base64
import math
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from mrgs.pictures.page_data import camera_facts, world_facts
from mrgs.scene import Camera, PointCloud, Scene
from mrgs.scene.view import evenly_spaced

Vector: TypeAlias = Float[np.ndarray, "3"]

MOST_POINTS = 4000
_TRIM = 0.08
"""Share of the points, at each end of each axis, that does not extend the box."""

_NEAR, _FAR = 2.5, 50.0
"""Distances from which the scene is seen, over the length that fills the view."""


class World(NamedTuple):
    """Cameras of the first image of each view, by the view's name, at least one; the views that are
    not trained on; points; whether scene units are metres; and whether the axes are east, north,
    up. Otherwise up is the mean direction of the cameras' upper edges."""

    cameras: Mapping[str, Camera]
    held_out: Collection[str]
    points: PointCloud
    metric: bool
    north: bool

    @classmethod
    def of(cls, scene: Scene | None) -> World | None:
        """The cameras and points of a scene."""
        if scene is None:
            return None
        cameras = {view.name: view.camera for view in scene.views}
        held_out = {view.name for view in scene.eval}
        return cls(cameras, held_out, scene.points, scene.world.metric, scene.world.north)


def orbit_facts(world: World) -> dict[str, Any]:
    """Data for ``orbit.js``; points are 16-bit integers in steps of ``step`` from ``low``."""
    chosen = evenly_spaced(len(world.points.positions), MOST_POINTS)
    points = world.points.positions[chosen].double().numpy()
    colors = world.points.colors[chosen].clamp(0, 1).numpy()
    positions = np.stack([camera.position.numpy() for camera in world.cameras.values()])
    low, high = _box(positions, points)
    size = float((high - low).max())
    corner, step = low - 0.5 * size, 2 * size / 65535
    quantised = np.rint((points - corner) / step)
    inside = ((quantised >= 0) & (quantised <= 65535)).all(axis=1)
    up = np.array([0.0, 0, 1] if world.north else world_facts([*world.cameras.values()])["up"])
    return {
        "cameras": [
            {"name": name, "heldOut": name in world.held_out, **camera_facts(camera)}
            for name, camera in world.cameras.items()
        ],
        "points": base64.b64encode(quantised[inside].astype("<u2").tobytes()).decode(),
        "colors": base64.b64encode(np.rint(colors[inside] * 255).astype("u1").tobytes()).decode(),
        "low": corner.tolist(),
        "step": step,
        "frustum": frustum_size(positions, float(np.linalg.norm(high - low))),
        "metric": world.metric,
        "world": {"focus": ((low + high) / 2).tolist(), "up": up.tolist()},
        "views": _viewpoints(world, up, low, high),
    }


def _box(
    positions: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "k 3"]
) -> tuple[Vector, Vector]:
    """The box of the cameras and of nearly all points."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    if len(points):
        low = np.minimum(low, np.quantile(points, _TRIM, axis=0))
        high = np.maximum(high, np.quantile(points, 1 - _TRIM, axis=0))
    return (low, high) if (high - low).max() > 0 else (low - 1, high + 1)


def frustum_size(positions: Float[np.ndarray, "n 3"], size: float) -> float:
    """Drawn depth of the cameras' pyramids: large enough to see, and hardly touching each other."""
    nearest = np.inf
    if len(positions) > 1:
        nearest = np.median(cKDTree(positions).query(positions, k=2)[0][:, 1])
    return float(np.clip(0.8 * nearest, 0.02 * size, 0.06 * size))


def _viewpoints(world: World, up: Vector, low: Vector, high: Vector) -> dict[str, Any]:
    """Cameras that see the whole box: aslant, from above, and from the side."""
    ahead = np.array([0.0, 1.0, 0.0])
    if not world.north:
        directions = np.stack([camera.forward.numpy() for camera in world.cameras.values()])
        for found in (directions.mean(axis=0), directions[0], np.eye(3)[np.abs(up).argmin()]):
            ahead = found - up * (found @ up)
            if np.linalg.norm(ahead) > 0.1:
                break
        ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, up)

    def seen_from(side: Vector, top: Vector, far: float, length: float) -> dict[str, Any]:
        lens = Camera.from_fov(400, 400, 2 * math.degrees(math.atan(0.5 / far)))
        centre = (low + high) / 2
        return camera_facts(lens.look_at(centre + far * length * side, centre, top))

    def extent(*axes: Vector) -> float:
        return 1.08 * max(float(np.abs(axis) @ (high - low)) for axis in axes)

    aslant = 0.5 * up - 0.7 * ahead + 0.5 * right
    return {
        "orbit": seen_from(aslant, up, _NEAR, 0.8 * float(np.linalg.norm(high - low))),
        "above": seen_from(up, ahead, _FAR, extent(right, ahead)),
        "side": seen_from(-ahead, up, _FAR, extent(right, up)),
    }
