"""Camera paths: how a person walks around what they photograph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from mrgs.scene import Camera, WorldFrame


@dataclass(frozen=True)
class CameraArc:
    """Cameras on arcs about a target, at several heights, all with one lens.

    Attributes:
        target: the point looked at, metres.
        azimuth_deg: first and last direction from the target to a camera, counter-clockwise from
            the x axis.
        rings: elevation above the horizon in degrees and distance from the target in metres, one
            pair per arc.
        fov_deg: horizontal field of view.
        jitter_m: how far hand and aim stray (standard deviation).
    """

    target: tuple[float, float, float]
    azimuth_deg: tuple[float, float]
    rings: tuple[tuple[float, float], ...]
    fov_deg: float = 55.0
    jitter_m: float = 0.02

    def train(self, count: int, width: int, height: int, rng: np.random.Generator) -> list[Camera]:
        """Cameras at even azimuths that change from ring to ring."""
        steps = (np.arange(count) + 0.5) / count
        return [
            self._camera(step, self.rings[index % len(self.rings)], width, height, rng)
            for index, step in enumerate(steps)
        ]

    def between(
        self, count: int, train_count: int, width: int, height: int, rng: np.random.Generator
    ) -> list[Camera]:
        """Cameras half-way between neighbours of ``train(train_count)``, in azimuth, elevation and
        distance.

        ``train_count`` is 2 or more; with as many cameras as gaps or fewer, no gap is used twice.
        """
        cameras = []
        for gap in gaps(count, train_count):
            lower, upper = (self.rings[i % len(self.rings)] for i in (gap - 1, gap))
            ring = ((lower[0] + upper[0]) / 2, (lower[1] + upper[1]) / 2)
            cameras.append(self._camera(gap / train_count, ring, width, height, rng))
        return cameras

    def _camera(
        self,
        step: float,
        ring: tuple[float, float],
        width: int,
        height: int,
        rng: np.random.Generator,
    ) -> Camera:
        first, last = self.azimuth_deg
        azimuth, elevation = np.radians(first + (last - first) * step), np.radians(ring[0])
        offset = np.array(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ]
        )
        position = np.array(self.target) + ring[1] * offset + rng.normal(0.0, self.jitter_m, 3)
        viewmat = look_at(position, np.array(self.target) + rng.normal(0.0, self.jitter_m, 3))
        return Camera(
            pinhole(self.fov_deg, width, height), torch.from_numpy(viewmat), width, height
        )


@dataclass(frozen=True, eq=False)
class Frame:
    """Coordinates that a scene is written in: x' = scale · rotation · x + shift, of x in metres,
    which are the scene's units only if the scale is 1."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]

    @property
    def world(self) -> WorldFrame:
        """What the scene says of its coordinates."""
        return WorldFrame(metric=self.scale == 1.0)

    def points(self, positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points in these coordinates."""
        return self.scale * positions @ self.rotation.T + self.shift

    def camera(self, camera: Camera) -> Camera:
        """A camera in these coordinates."""
        turned = camera.viewmat[:3, :3].numpy() @ self.rotation.T
        viewmat = np.eye(4)
        viewmat[:3, :3] = turned
        viewmat[:3, 3] = self.scale * camera.viewmat[:3, 3].numpy() - turned @ self.shift
        return Camera(camera.K, torch.from_numpy(viewmat), camera.width, camera.height)


WORLD = Frame(1.0, np.eye(3), np.zeros(3))
"""The stage's own coordinates."""


def gaps(count: int, train_count: int) -> list[int]:
    """Of cameras between those of ``CameraArc.train``, each one's successor among them."""
    return [1 + int((index + 0.5) * (train_count - 1) / count) for index in range(count)]


def look_at(
    position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """World to camera (OpenCV axes) for a camera whose image's upper edge is towards +z; not for a
    vertical view."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ position
    return viewmat


def pinhole(fov_deg: float, width: int, height: int) -> torch.Tensor:
    """Intrinsics K [3, 3] of square pixels and a centred optical axis, from the horizontal field of
    view."""
    focal = width / 2 / np.tan(np.radians(fov_deg) / 2)
    return torch.tensor(
        [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=torch.float64
    )
