from __future__ import annotations

import torch

from mrgs_thermonerf.networks import INITIAL_RANGE, GridSize, HashGrid


def test_resolutions_grow_geometrically_between_the_two_ends():
    assert GridSize(5, 16, 256, 15).resolutions == [16, 32, 64, 128, 256]
    assert GridSize(1, 8, 64, 10).resolutions == [8]


def test_a_level_has_an_entry_per_corner_or_the_most_there_may_be():
    grid = HashGrid(GridSize(3, 4, 64, 10))
    assert grid.offsets.tolist() == [0, 125, 125 + 1024, 125 + 2048]
    assert grid.table.shape == (125 + 2048, 4)
    assert 0 < grid.table.abs().max() <= INITIAL_RANGE
    assert grid(torch.rand(7, 3)).shape == (7, grid.width) == (7, 12)
