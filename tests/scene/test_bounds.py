from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

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


@given(
    st.lists(st.tuples(st.floats(0, 2 * math.pi), st.floats(0.2, 3)), min_size=3, max_size=12),
    st.integers(0, 2**32 - 1),
)
def test_an_outline_holds_the_points_of_its_triangles(polar, seed):
    """Star-shaped about the origin, so that it is the union of the triangles at its sides."""
    polar = sorted(polar)
    gaps = np.diff([angle for angle, _ in polar], append=polar[0][0] + 2 * math.pi)
    assume(((gaps > 1e-3) & (gaps < math.pi - 1e-3)).all())
    outline = [(r * math.cos(angle), r * math.sin(angle)) for angle, r in polar]
    points = np.random.default_rng(seed).uniform(-3, 3, (200, 3))
    points[::10, 2] = 99
    found = Box.around([outline], -3, 3).contains(torch.from_numpy(points)).numpy()
    expected, unsure = np.zeros(200, bool), np.zeros(200, bool)
    for a, b in zip(outline, outline[1:] + outline[:1], strict=True):
        shares = np.linalg.solve(np.array([a, b]).T, points[:, :2].T)
        least = np.minimum(shares.min(axis=0), 1 - shares.sum(axis=0))
        expected |= least > 0
        unsure |= abs(least) < 1e-9
    expected &= points[:, 2] < 3
    np.testing.assert_array_equal(found[~unsure], expected[~unsure])


def test_sides_that_cross_and_points_that_are_not_numbers():
    bow = [(0, 0), (4, 4), (4, 0), (0, 4)]  # two triangles that touch in the middle
    box = Box.around([bow], 0, 1)
    places = torch.tensor([[0.5, 2, 0.5], [3.5, 2, 0.5], [2, 0.5, 0.5], [math.nan, 2, 0.5]])
    assert box.contains(places).tolist() == [True, True, False, False]
    assert box.contains(places.reshape(2, 2, 3)).shape == (2, 2)


def test_what_is_in_two_boxes_is_in_all_their_outlines():
    left = Box.around([[(0, 0), (2, 0), (0, 2)]], 0, 4)
    right = Box.around([[(0, 0), (2, 0), (2, 2)]], 1, 5)
    places = 2.5 * torch.rand(1000, 3, generator=torch.Generator().manual_seed(0)) * 2
    both = left.within(right)
    torch.testing.assert_close(
        both.contains(places), left.contains(places) & right.contains(places)
    )
    assert left.within(left) == left
    assert "within an outline of 3 corners" in str(both)


@pytest.mark.parametrize(
    ("outlines", "message"),
    [
        ([[(0, 0), (1, 1)]], "3 to 200 corners"),
        ([[(i, i % 7) for i in range(201)]], "3 to 200 corners"),
        ([[(0, 0), (1, 0), (0, 1)]] * 21, "at most 20 outlines"),
        ([[(0, 0), (0, 1), (0, 2)]], "no inside"),
        ([[(0, 0), (0, math.nan), (1, 2)]], "3 to 200 corners"),
    ],
)
def test_outlines_that_cannot_be_are_refused(outlines, message):
    with pytest.raises(ConfigError, match=f"crop: .*{message}"):
        Box.around(outlines, 0, 1)
