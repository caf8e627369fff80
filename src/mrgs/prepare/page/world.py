"""Cameras and points: data for the page's 3D view, and two drawings for print."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from markupsafe import Markup
from scipy.spatial import cKDTree

from mrgs.pictures.html import render
from mrgs.pictures.palette import round_down
from mrgs.scene import Camera, PointCloud
from mrgs.scene.view import evenly_spaced

MOST_POINTS = 4000
_PLAN_POINTS = 1500
_PLAN_PX = 440
_TRIM = 0.08
"""Share of the points, at each end of each axis, that does not extend the drawing."""

_BAR_SHARE = 0.25


@dataclass(frozen=True, eq=False)
class World:
    """Cameras and points in axes for drawing.

    Attributes:
        cameras: of the first image of each view, by the view's name, in order.
        held_out: names of the views that are not trained on.
        points: [N, 3], in scene units.
        colors: RGB in [0, 1], [N, 3].
        up: which way is up, unit length [3].
        metric: whether scene units are metres.
        north: whether the axes are east, north, up.
    """

    cameras: Mapping[str, Camera]
    held_out: frozenset[str]
    points: Float32[np.ndarray, "n 3"]
    colors: Float32[np.ndarray, "n 3"]
    up: Float[np.ndarray, "3"]
    metric: bool
    north: bool


def world_of(
    cameras: Mapping[str, Camera],
    held_out: frozenset[str],
    points: PointCloud,
    metric: bool,
    north: bool,
) -> World:
    """Cameras and points for drawing; without north, up is the mean direction of the cameras' upper
    edges."""
    up = np.array([0.0, 0.0, 1.0])
    if not north and cameras:
        mean = (
            -torch.stack([camera.viewmat[1, :3] for camera in cameras.values()]).mean(dim=0).numpy()
        )
        first = -next(iter(cameras.values())).viewmat[1, :3].numpy()
        up = mean / np.linalg.norm(mean) if np.linalg.norm(mean) > 1e-6 else first
    shown = evenly_spaced(len(points.positions), MOST_POINTS)
    return World(
        cameras,
        held_out,
        points.positions[shown].numpy(),
        points.colors[shown].clamp(0, 1).numpy(),
        up,
        metric,
        north,
    )


def orbit_facts(world: World) -> dict[str, Any]:
    """Data of the 3D view; positions are 16-bit integers in steps of ``step`` from ``low``."""
    positions = np.stack([camera.position.numpy() for camera in world.cameras.values()])
    low, high = _box(world, positions)
    size, diagonal = float((high - low).max()), float(np.linalg.norm(high - low))
    corner, step = low - 0.5 * size, 2 * size / 65535
    quantised = np.rint((world.points - corner) / step)
    inside = ((quantised >= 0) & (quantised <= 65535)).all(axis=1)
    return {
        "cameras": [
            _camera_facts(name, camera, name in world.held_out)
            for name, camera in world.cameras.items()
        ],
        "points": _base64(quantised[inside].astype("<u2")),
        "colors": _base64(np.rint(world.colors[inside] * 255).astype(np.uint8)),
        "low": _rounded(corner),
        "step": step,
        "centre": _rounded((low + high) / 2),
        "radius": diagonal / 2,
        "frustum": frustum_size(positions, diagonal),
        "up": _rounded(world.up),
        "metric": world.metric,
    }


def _camera_facts(name: str, camera: Camera, held_out: bool) -> dict[str, Any]:
    return {
        "name": name,
        "heldOut": held_out,
        "position": _rounded(camera.position.numpy()),
        "rotation": _rounded(camera.viewmat[:3, :3].numpy().ravel()),
        "slopes": _rounded(_slopes(camera)),
    }


def _slopes(camera: Camera) -> Float[np.ndarray, "2"]:
    """Half the image's width and height at depth 1."""
    return np.array([camera.width, camera.height]) / 2 / camera.K.diagonal()[:2].numpy()


def frustum_size(positions: Float[np.ndarray, "n 3"], size: float) -> float:
    """Drawn depth of the cameras' pyramids: large enough to see, and hardly touching each other."""
    nearest = np.inf
    if len(positions) > 1:
        nearest = np.median(cKDTree(positions).query(positions, k=2)[0][:, 1])
    return float(np.clip(0.8 * nearest, 0.02 * size, 0.06 * size))


def plans(world: World) -> list[tuple[str, Markup]]:
    """Caption and SVG of two drawings, from above and from the side."""
    right, ahead = _horizontal_axes(world)
    above = "From above" + (", north is up" if world.north else "")
    return [(above, _plan(world, right, ahead)), ("From the side", _plan(world, right, world.up))]


def _horizontal_axes(world: World) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """East and north, or axes in which the cameras look up on average if north is not known."""
    if world.north:
        return np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    directions = np.stack([camera.forward.numpy() for camera in world.cameras.values()])
    for direction in (directions.mean(axis=0), directions[0], np.eye(3)[np.abs(world.up).argmin()]):
        ahead = direction - world.up * (direction @ world.up)
        if np.linalg.norm(ahead) > 0.1:
            break
    ahead = ahead / np.linalg.norm(ahead)
    return np.cross(ahead, world.up), ahead


def _plan(world: World, right: Float[np.ndarray, "3"], upwards: Float[np.ndarray, "3"]) -> Markup:
    """An orthographic drawing as SVG: x along ``right``, y along ``upwards``."""
    axes = np.stack([right, -upwards])
    positions = np.stack([camera.position.numpy() for camera in world.cameras.values()])
    box = _box(world, positions)
    corners = np.stack(np.meshgrid(*zip(*box, strict=True)), axis=-1).reshape(-1, 3) @ axes.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = float((high - low).max()) * 1.08
    scale = _PLAN_PX / size
    origin = (low + high) / 2 - size / 2
    length = frustum_size(positions, size)
    cameras = []
    for name, camera in world.cameras.items():
        apex = (camera.position.numpy() @ axes.T - origin) * scale
        outline = _outline(apex, _cone(camera, length) @ axes.T * scale)
        cameras.append((name, name in world.held_out, outline))
    return render(
        "prepare/page/plan.svg",
        size=_PLAN_PX,
        dots=_dots((world.points @ axes.T - origin) * scale, world.colors),
        cameras=cameras,
        bar=_scale_bar(world, scale),
    )


def _outline(apex: Float[np.ndarray, "2"], cone: Float[np.ndarray, "4 2"]) -> str:
    """The path of a camera's pyramid: four edges and the image's rim."""
    edges = "".join(f"M{apex[0]:.1f} {apex[1]:.1f}l{x:.1f} {y:.1f}" for x, y in cone)
    return edges + "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in apex + cone) + "z"


def _cone(camera: Camera, length: float) -> Float[np.ndarray, "4 3"]:
    """From the camera's centre to the corners of its image at this depth."""
    x, y = _slopes(camera)
    corners = np.array([[-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]]) * length
    return corners @ camera.viewmat[:3, :3].numpy()


def _dots(
    pixels: Float[np.ndarray, "n 2"], colors: Float[np.ndarray, "n 3"]
) -> list[tuple[str, str]]:
    """Colour and path of the points; those of one colour share a path, which keeps the file
    small."""
    chosen = evenly_spaced(len(pixels), _PLAN_POINTS)
    pixels, levels = pixels[chosen], np.rint(colors[chosen] * 5).astype(int)
    inside = ((pixels >= 0) & (pixels <= _PLAN_PX)).all(axis=1)
    by_color: dict[str, list[str]] = {}
    for (x, y), level in zip(pixels[inside], levels[inside], strict=True):
        color = "#" + "".join(f"{40 * value:02x}" for value in level.tolist())
        by_color.setdefault(color, []).append(f"M{x:.0f} {y:.0f}h0")
    return [(color, "".join(dots)) for color, dots in by_color.items()]


def _scale_bar(world: World, scale: float) -> tuple[float, str]:
    """A round length in pixels of the drawing, and its label."""
    length = round_down(_BAR_SHARE * _PLAN_PX / scale)
    label = (
        f"{length:g} m"
        if world.metric
        else f"{length:g} unit{'' if length == 1 else 's'}, scale not known"
    )
    return length * scale, label


def _box(
    world: World, positions: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """The box of the cameras and of nearly all points."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    if len(world.points):
        low = np.minimum(low, np.quantile(world.points, _TRIM, axis=0))
        high = np.maximum(high, np.quantile(world.points, 1 - _TRIM, axis=0))
    if not (high - low).max() > 0:
        low, high = low - 1, high + 1
    return low, high


def _rounded(values: Float[np.ndarray, " n"]) -> list[float]:
    return [float(f"{value:.7g}") for value in values]


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")
