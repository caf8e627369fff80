"""Cameras: the browser's, the captured one nearest to it, and those of a path through keyframes."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from mrgs.errors import ConfigError
from mrgs.scene import Camera, View
from mrgs.scene.camera import field_of_view
from mrgs.scene.rotations import (
    matrix_from_quaternion,
    opengl_camera_to_world,
    rigid_transform,
)
from mrgs.system.atomic import write_text


def pinhole(
    wxyz: Float[np.ndarray, "4"],
    position: Float[np.ndarray, "3"],
    fov: float,
    width: int,
    height: int,
) -> Camera:
    """A pinhole camera with square pixels and a centred principal point.

    Args:
        wxyz: rotation from the camera's OpenCV axes to the world, a unit quaternion.
        position: in world coordinates.
        fov: vertical field of view, radians.
        width: pixels.
        height: pixels.
    """
    focal = 0.5 * height / math.tan(0.5 * fov)
    K = torch.tensor(
        [[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]], dtype=torch.float64
    )
    rotation = matrix_from_quaternion(wxyz).T
    return Camera(K, rigid_transform(rotation, -rotation @ np.asarray(position)), width, height)


def vertical_fov(camera: Camera) -> float:
    """Vertical field of view of a camera, radians."""
    return field_of_view(camera.height, camera.K[1, 1].item())


def fitted_size(width: int, height: int, longest: int) -> tuple[int, int]:
    """Width and height in pixels, reduced so that the longer side has at most ``longest``; each at
    least 1."""
    scale = min(1.0, longest / max(width, height, 1))
    return max(1, round(width * scale)), max(1, round(height * scale))


def camera_around(means: Float[np.ndarray, "n 3"]) -> Camera:
    """The first viewpoint for a model without known cameras: towards its middle; z is up."""
    centre = np.median(means, axis=0).astype(np.float64)
    radius = float(np.median(np.linalg.norm(means - centre, axis=1))) or 1.0
    position = centre + 2.5 * radius * np.array([1.0, -1.0, 0.6])
    at_origin = pinhole(np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), math.radians(50), 800, 600)
    return at_origin.look_at(position, centre)


def nearest_view(
    views: Sequence[View], camera: Camera, extent: float, preferred: int | None = None
) -> int:
    """Index of the captured view whose position and direction are closest to a camera's; ties go to
    ``preferred``.

    Args:
        views: at least one.
        camera: the one to compare with.
        extent: of the scene; a way of this length weighs as much as a right angle.
        preferred: index of the view shown now.
    """
    costs = []
    for index, view in enumerate(views):
        other = view.camera
        way = (other.position - camera.position).norm().item() / extent
        turn = 1 - (other.forward @ camera.forward).item()
        costs.append(way + turn - (1e-3 if index == preferred else 0.0))
    return int(np.argmin(costs))


def smooth_path(keyframes: Sequence[Camera], frames: int) -> list[Camera]:
    """Cameras along a smooth curve through the keyframes, evenly in time; the size is that of the
    first.

    Raises:
        ConfigError: fewer than two keyframes.
    """
    if len(keyframes) < 2:
        raise ConfigError("a camera path needs at least two keyframes: add them from two places")
    times = np.arange(len(keyframes), dtype=np.float64)
    wanted = np.linspace(0, times[-1], max(frames, 2))
    positions = CubicSpline(
        times, np.stack([camera.position.numpy() for camera in keyframes]), bc_type="natural"
    )
    turns = Rotation.from_matrix([camera.viewmat[:3, :3].numpy().T for camera in keyframes])
    quaternions = RotationSpline(times, turns)(wanted).as_quat(scalar_first=True)
    fovs = np.interp(wanted, times, [vertical_fov(camera) for camera in keyframes])
    width, height = keyframes[0].width, keyframes[0].height
    return [
        pinhole(wxyz, position, float(fov), width, height)
        for wxyz, position, fov in zip(quaternions, positions(wanted), fovs, strict=True)
    ]


def save_path(path: Path, keyframes: Sequence[Camera], seconds: float, fps: int) -> Path:
    """Write the keyframes as nerfstudio's camera-path JSON (camera to world, OpenGL axes); returns
    the path.

    Raises:
        ConfigError: there are no keyframes.
        RunError: the file cannot be written.
    """
    if not keyframes:
        raise ConfigError("there are no keyframes to save: add some first")
    entries = []
    for camera in keyframes:
        degrees = math.degrees(vertical_fov(camera))
        entries.append(
            {
                "camera_to_world": opengl_camera_to_world(camera.viewmat).flatten().tolist(),
                "fov": degrees,
                "aspect": camera.width / camera.height,
            }
        )
    document = {
        "camera_type": "perspective",
        "render_width": keyframes[0].width,
        "render_height": keyframes[0].height,
        "seconds": seconds,
        "fps": fps,
        "camera_path": entries,
    }
    return write_text(path, json.dumps(document, indent=1))
