from __future__ import annotations

import pytest
import torch

from mrgs.errors import ConfigError
from mrgs.scene import Box, Camera, SceneBounds
from mrgs.scene.world import TIMES_AS_FAR


def camera_at(*position: float) -> Camera:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = -torch.tensor(position, dtype=torch.float64)
    K = torch.tensor([[50.0, 0, 32.0], [0, 50.0, 24.0], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, viewmat, 64, 48)


def shell(count: int, radius: float) -> torch.Tensor:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return radius * torch.nn.functional.normalize(points, dim=1)


def test_a_few_stray_points_do_not_count():
    cameras = [camera_at(-1.0, 0, 0), camera_at(3.0, 0, 0)]
    points = torch.cat([shell(995, 10.0), shell(5, 1e4)]) + torch.tensor([1.0, 0, 0])
    ball = SceneBounds.of(points, cameras)
    torch.testing.assert_close(ball.centre, torch.tensor([1.0, 0, 0]).double())
    assert ball.radius == pytest.approx(10)


def test_the_cameras_are_inside():
    assert SceneBounds.of(
        shell(100, 0.1), [camera_at(-5.0, 0, 0), camera_at(5.0, 0, 0)]
    ).radius == pytest.approx(5)


def test_what_is_nearer_to_the_background_than_to_the_scene_belongs_to_it():
    ball = SceneBounds.of(shell(100, 2.0), [camera_at(0.0, 0, 0)])
    assert ball.background_distance == pytest.approx(2 * TIMES_AS_FAR)
    distances = torch.tensor(
        [
            0.0,
            2.0,
            0.9 * (1 + TIMES_AS_FAR),
            1.1 * (1 + TIMES_AS_FAR),
            ball.background_distance,
            torch.nan,
        ]
    )
    points = distances[:, None] * torch.tensor([0.0, 0.6, 0.8])
    assert ball.is_background(points).tolist() == [False, False, False, True, True, False]


def test_depths_of_the_background_become_infinite_and_unknown_ones_stay_so():
    camera = camera_at(0.0, 0, 0)
    ball = SceneBounds.of(shell(100, 2.0), [camera])
    depth = torch.full((camera.height, camera.width), 2.0)
    depth[0, 0], depth[1, 1] = ball.background_distance, torch.nan
    found = ball.without_background(camera, depth)
    expected = depth.clone()
    expected[0, 0] = torch.inf
    torch.testing.assert_close(found, expected, equal_nan=True)


def test_a_box_is_spanned_by_any_two_opposite_corners():
    box = Box.between(1, -2, 3, -1, 2, 0)
    assert box == Box((-1, -2, 0), (1, 2, 3))
    places = torch.tensor([[0, 0, 0], [1, 2, 3], [0, 0, 3.1], [-1.1, 0, 0], [torch.nan, 0, 0]])
    assert box.contains(places).tolist() == [True, True, False, False, False]


@pytest.mark.parametrize("corner", [(1, 1, 0), (1, 1, float("nan")), (1, float("inf"), 1)])
def test_corners_that_span_no_box_are_refused(corner):
    with pytest.raises(ConfigError, match="crop"):
        Box.between(0, 0, 0, *corner)
