from __future__ import annotations

import numpy as np
import pytest
import torch

from mrgs.field.heat import nearest_neighbours as nearest_neighbours_plain
from mrgs.field.heat import neighbour_distances
from mrgs.kernels import neighbours
from mrgs.kernels.neighbours import nearest_neighbours
from mrgs.scene.point_cloud import CROWDED
from mrgs.system.operation import disable_kernels


def crowded_points(each: int) -> torch.Tensor:
    """So many points at each of two places, and 140 others about them, in random order."""
    generator = torch.Generator().manual_seed(3)
    places = [torch.tensor([1.0, 0.0, -0.0]), torch.tensor([1.0, 0.2, 0.1])]
    others = torch.randn(140, 3, generator=generator)
    points = torch.cat([*(place.expand(each, 3) for place in places), others])
    return points[torch.randperm(len(points), generator=generator)]


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """The points that were put into trees."""
    seen: list[np.ndarray] = []

    def tree(points: np.ndarray, **options: bool):
        seen.append(points)
        return search(points, **options)

    search = neighbours.cKDTree
    monkeypatch.setattr(neighbours, "cKDTree", tree)
    return seen


@pytest.mark.parametrize("k", [1, 8, 60, 299])
def test_points_at_crowded_places_have_their_nearest_neighbours(k):
    points = crowded_points(CROWDED + 50)
    found = nearest_neighbours(points, k)
    with disable_kernels():
        expected = nearest_neighbours_plain(points, k)
    torch.testing.assert_close(
        neighbour_distances(found, points, k), neighbour_distances(expected, points, k)
    )
    assert (found != torch.arange(len(points))[:, None]).all()
    assert all(len(set(row)) == k for row in found.tolist())


@pytest.mark.parametrize("flat", [False, True])
def test_no_tree_holds_a_crowd(flat, searched):
    points = torch.rand(9000, 3, generator=torch.Generator().manual_seed(0))
    points[:5000] = points[0]
    points[:, 0] *= not flat
    nearest_neighbours(points, 8)
    (kept,) = searched
    assert len(kept) == 4000 + 8 + 1
    assert np.unique(kept, axis=0, return_counts=True)[1].max() <= CROWDED


def test_a_few_points_at_one_place_are_searched_as_all_others(searched):
    points = crowded_points(80)
    nearest_neighbours(points, 8)
    assert np.array_equal(searched[0], points.double().numpy())
