"""Smooth camera paths for fly-throughs, from the cameras of a capture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mrgs.errors import ConfigError
from mrgs.scene import Camera


def orbit(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """A closed ellipse through the middle of the cameras, each pose looking at the point that they
    look at, in the plane that fits the camera centres best; half axes are √2 standard deviations,
    so that cameras spread evenly over an ellipse get that ellipse back. Intrinsics are the first
    camera's; of the ``frames`` poses the last is followed by the first. ConfigError without
    cameras, or for fewer than one frame."""
    if not cameras:
        raise ConfigError("a camera path needs at least one training camera")
    if frames < 1:
        raise ConfigError(f"a camera path needs at least one frame, got {frames}")
    positions = np.stack([camera.position.numpy() for camera in cameras])
    centre = positions.mean(axis=0)
    _, spread, axes = np.linalg.svd(positions - centre, full_matrices=True)
    spread = np.pad(spread, (0, 3))[:2] / np.sqrt(len(cameras))
    angles = np.linspace(0, 2 * np.pi, frames, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    target = focus_point(cameras)
    mean_up = -np.stack([camera.viewmat[1, :3].numpy() for camera in cameras]).mean(axis=0)
    path = []
    for position in centre + np.sqrt(2) * (circle * spread) @ axes[:2]:
        forward, up = target - position, mean_up
        if np.linalg.norm(np.cross(forward, up)) < 1e-6 * np.linalg.norm(forward):
            up = np.eye(3)[np.abs(forward).argmin()]
        path.append(cameras[0].look_at(position, target, up))
    return path


def focus_point(cameras: Sequence[Camera]) -> Float[np.ndarray, "3"]:
    """The point closest to all optical axes (least squares); where they hardly meet, or behind the
    cameras, the point ahead of the cameras' centre at the distance of their spread."""
    positions = np.stack([camera.position.numpy() for camera in cameras])
    directions = np.stack([camera.forward.numpy() for camera in cameras])
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    system = across.sum(axis=0)
    if np.linalg.eigvalsh(system)[0] > 1e-3 * len(cameras):
        point = np.linalg.solve(system, (across @ positions[:, :, None]).sum(axis=0)[:, 0])
        if np.median(((point - positions) * directions).sum(axis=1)) > 0:
            return point
    centre = positions.mean(axis=0)
    distance = 2 * np.linalg.norm(positions - centre, axis=1).max() or 1.0
    mean_direction = directions.mean(axis=0)
    ahead = mean_direction if np.linalg.norm(mean_direction) > 1e-6 else directions[0]
    return centre + distance * ahead / np.linalg.norm(ahead)
