from __future__ import annotations

import pytest
import torch

from mrgs.baselines.thermonerf.networks import INITIAL_RANGE, HashGrid, HashGridConfig
from mrgs.errors import ConfigError


def test_resolutions_grow_geometrically_between_the_two_ends():
    assert HashGridConfig(5, 16, 256, 15).resolutions == [16, 32, 64, 128, 256]
    assert HashGridConfig(1, 8, 64, 10).resolutions == [8]


def test_a_level_has_an_entry_per_corner_or_the_most_there_may_be():
    grid = HashGrid(HashGridConfig(3, 4, 64, 10))
    assert grid.offsets.tolist() == [0, 125, 125 + 1024, 125 + 2048]
    assert grid.table.shape == (125 + 2048, 4)
    assert 0 < grid.table.abs().max() <= INITIAL_RANGE
    assert grid(torch.rand(7, 3)).shape == (7, grid.width) == (7, 12)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((0, 4, 8, 10), "levels .*not 0"),
        ((2, 8, 4, 10), "resolutions .*not 8, 4"),
        ((2, 4, 8, 30), "log2_entries .*not 30"),
    ],
)
def test_sizes_that_are_not_allowed_are_named(values, message):
    with pytest.raises(ConfigError, match=message):
        HashGridConfig(*values)
