from __future__ import annotations

import numpy as np
import pytest
import torch

from mrgs.data.sources import ReadingNotes, point_cloud
from mrgs.scene import Camera
from mrgs.scene.point_cloud import RANDOM_POINTS, random_points

K = torch.tensor([[50.0, 0, 32], [0, 50.0, 24], [0, 0, 1]], dtype=torch.float64)


def looking(position, target) -> Camera:
    position, target = torch.tensor(position).double(), torch.tensor(target).double()
    forward = torch.nn.functional.normalize(target - position, dim=0)
    right = torch.nn.functional.normalize(
        torch.linalg.cross(forward, torch.tensor([0.0, 0.1, 1.0]).double()), dim=0
    )
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
    return Camera(K, viewmat, 64, 48)


def seen_by(camera: Camera, positions: torch.Tensor) -> torch.Tensor:
    in_camera = positions.double() @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixel = in_camera @ camera.K.T
    u, v = pixel[:, 0] / pixel[:, 2], pixel[:, 1] / pixel[:, 2]
    return (pixel[:, 2] > 0) & (u >= -1e-3) & (u <= 64.001) & (v >= -1e-3) & (v <= 48.001)


def test_around_an_object_the_points_gather_on_it():
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    cameras = [looking([5 + 4 * np.cos(a), 4 * np.sin(a), 1.0], [5.0, 0.0, 0.0]) for a in angles]
    points = random_points(cameras, seed=0)
    assert points.positions.shape == points.colors.shape == (RANDOM_POINTS, 3)
    assert points.random
    assert torch.stack([seen_by(camera, points.positions) for camera in cameras]).any(dim=0).all()
    near = (points.positions - torch.tensor([5.0, 0, 0])).norm(dim=1) < 2
    assert near.float().mean() > 0.1


def test_before_a_facade_the_points_fill_the_space_in_front():
    cameras = [looking([x, 0.0, 0.0], [x, 10.0, 0.0]) for x in (-1.0, 0.0, 1.0)]
    positions = random_points(cameras, seed=0).positions
    assert torch.stack([seen_by(camera, positions) for camera in cameras]).any(dim=0).all()
    assert positions[:, 1].min() > 0.5
    assert 4 < positions[:, 1].max() < 20


def test_a_single_camera_is_enough():
    camera = looking([0.0, 0.0, 0.0], [0.0, 10.0, 0.0])
    assert seen_by(camera, random_points([camera], seed=0).positions).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200, 1e30])
def test_points_that_float32_cannot_hold_are_dropped(bad):
    notes = ReadingNotes()
    cloud = point_cloud(np.array([[0, 0, bad], [1, 2, -75.0]]), None, notes)
    assert cloud.positions.tolist() == [[1, 2, -75]]
    assert cloud.colors.tolist() == [[0.5, 0.5, 0.5]]
    assert "1 start points" in notes.repaired[0]


def test_no_points_left():
    assert point_cloud(np.empty((0, 3)), None, ReadingNotes()) is None


def test_the_transform_is_applied():
    turn = np.array([[0, 1, 0, 5], [1, 0, 0, 0], [0, 0, -1, 0]], dtype=float)
    assert point_cloud(np.array([[1.0, 2, 3]]), None, ReadingNotes(), turn).positions.tolist() == [
        [7, 1, -3]
    ]
