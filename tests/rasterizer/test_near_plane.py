from __future__ import annotations

import pytest
import torch

from mrgs.rasterizer.near_plane import TooNear, too_near
from tests.helpers.views import small_camera


def wall(depth: float, count: int = 1000) -> torch.Tensor:
    """Points of a wall before ``small_camera``, all in its image."""
    across = torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) - 0.5
    return torch.cat([across * 0.5 * depth, torch.full((count, 1), depth)], dim=1)


@pytest.mark.parametrize(("depth", "factor"), [(0.0099, 1_000), (1e-3, 1_000), (9e-9, 10**9)])
def test_a_wall_before_the_near_plane_is_too_near(depth, factor):
    assert too_near([small_camera()], wall(depth)) == TooNear(1.0, factor)


@pytest.mark.parametrize("depth", [0.0101, 1.0, 1e6])
def test_a_wall_behind_it_is_not(depth):
    assert too_near([small_camera()], wall(depth)) is None


def test_only_what_the_cameras_see_counts():
    beside = wall(1e-3) + torch.tensor([1.0, 0, 0])
    behind = wall(-1e-3)
    assert too_near([small_camera()], torch.cat([wall(0.02), beside, behind])) is None
    assert too_near([small_camera()], behind) is None
    assert too_near([small_camera()], torch.empty(0, 3)) is None


def test_strays_do_not_count():
    assert too_near([small_camera()], torch.cat([wall(1e-3, 200), wall(2.0)])) is None
    assert too_near([small_camera()], torch.cat([wall(1e-3, 5), wall(0.5)])) is None
    found = too_near([small_camera(), small_camera()], torch.cat([wall(1e-3, 200), wall(0.5, 800)]))
    assert found is not None
    assert found.share == pytest.approx(0.2)
    assert found.factor == 10
