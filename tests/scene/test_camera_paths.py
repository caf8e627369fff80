from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mrgs.errors import ConfigError
from mrgs.scene import Camera
from mrgs.scene.camera import focus_point, orbit

K = torch.tensor([[50.0, 0, 16], [0, 60.0, 12], [0, 0, 1]], dtype=torch.float64)


def looking(
    position: np.ndarray, target: np.ndarray, up: tuple[float, float, float] = (0, 0, 1)
) -> Camera:
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.from_numpy(rotation)
    viewmat[:3, 3] = torch.from_numpy(-rotation @ position)
    return Camera(K, viewmat, 32, 24)


def ring(count: int = 12, a: float = 3.0, b: float = 2.0, height: float = 1.0) -> list[Camera]:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    points = np.stack([a * np.cos(angles), b * np.sin(angles), np.full(count, height)], axis=1)
    return [looking(point, np.array([0.3, 0.1, 0.2])) for point in points]


def assert_orthonormal(cameras: list[Camera]) -> None:
    for camera in cameras:
        rotation = camera.viewmat[:3, :3]
        torch.testing.assert_close(
            rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-9, rtol=0
        )
        assert torch.linalg.det(rotation).item() == pytest.approx(1.0)
        assert camera.viewmat[3].tolist() == [0, 0, 0, 1]
        assert (camera.width, camera.height) == (32, 24)
        assert torch.equal(camera.K, K)


def positions(cameras: Sequence[Camera]) -> np.ndarray:
    return np.stack([camera.position.numpy() for camera in cameras])


@pytest.mark.parametrize("frames", [1, 2, 25])
def test_poses_are_rigid(frames: int) -> None:
    cameras = orbit(ring(), frames)
    assert len(cameras) == frames
    assert_orthonormal(cameras)


def test_the_focus_is_where_the_axes_meet() -> None:
    np.testing.assert_allclose(focus_point(ring()), [0.3, 0.1, 0.2], atol=1e-9)


def test_an_orbit_recovers_the_ellipse_and_looks_at_the_focus() -> None:
    path = orbit(ring(), 40)
    x, y, z = positions(path).T
    np.testing.assert_allclose((x / 3) ** 2 + (y / 2) ** 2, 1.0, atol=1e-6)
    np.testing.assert_allclose(z, 1.0, atol=1e-9)
    for camera in path:
        in_camera = camera.viewmat @ torch.tensor([0.3, 0.1, 0.2, 1.0], dtype=torch.float64)
        torch.testing.assert_close(
            in_camera[:2], torch.zeros(2, dtype=torch.float64), atol=1e-9, rtol=0
        )
        assert in_camera[2] > 0
        assert camera.viewmat[1, 2] < 0  # the camera's down points to the world's down


def test_an_orbit_is_closed_and_smooth() -> None:
    path = positions(orbit(ring(), 60))
    steps = np.linalg.norm(np.diff(path, axis=0, append=path[:1]), axis=1)
    assert steps.max() < 1.7 * steps.min()


def test_the_order_of_the_cameras_does_not_matter_to_an_orbit() -> None:
    cameras = ring()
    forward, shuffled = positions(orbit(cameras, 30)), positions(orbit(cameras[::-1], 30))
    distances = np.linalg.norm(forward[:, None] - shuffled[None], axis=2)
    assert distances.min(axis=1).max() < 1e-6


@pytest.mark.parametrize("along", [(0.0, -1.0, 0.0), (0.0, 0.0, -1.0)])
def test_parallel_cameras_keep_their_direction(along: tuple[float, float, float]) -> None:
    direction = np.array(along)
    up = (0, 0, 1) if direction[2] == 0 else (0, 1, 0)
    side = np.linspace(-2, 2, 9)
    cameras = [
        looking(np.array([x, 5.0, 5.0]), np.array([x, 5.0, 5.0]) + direction, up) for x in side
    ]
    for camera in orbit(cameras, 12):
        assert camera.forward.numpy() @ direction > 0.8
    assert_orthonormal(orbit(cameras, 12))


def test_outward_views_do_not_take_a_focus_behind_them() -> None:
    cameras = [
        looking(np.array([np.cos(t), np.sin(t), 0.0]), 5 * np.array([np.cos(t), np.sin(t), 0.0]))
        for t in (0, 1)
    ]
    assert all((focus_point(cameras) - c.position.numpy()) @ c.forward.numpy() > 0 for c in cameras)


def test_a_single_camera() -> None:
    camera = ring()[0]
    cameras = orbit([camera], 3)
    assert_orthonormal(cameras)
    np.testing.assert_allclose(positions(cameras), positions([camera] * 3), atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 9), st.integers(1, 20))
def test_any_capture_gives_finite_rigid_poses(seed: int, count: int, frames: int) -> None:
    generator = np.random.default_rng(seed)
    cameras = [
        looking(generator.normal(size=3) * 3, generator.normal(size=3)) for _ in range(count)
    ]
    assert_orthonormal(orbit(cameras, frames))


def test_errors() -> None:
    with pytest.raises(ConfigError, match="training camera"):
        orbit([], 5)
    with pytest.raises(ConfigError, match="frame, got 0"):
        orbit(ring(), 0)
