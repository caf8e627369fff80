from __future__ import annotations

import math

import pytest
import torch

from mrgs.blocks.region import Region, cells, parse_grid, plane_of, shape_for, without_empty
from mrgs.data import load_scene
from mrgs.errors import ConfigError
from tests.helpers.scenes import write_scene

PLACES = torch.rand(1000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_cells_fill_the_plane_without_overlap_and_hold_equally_many_places():
    found = [cell for column in cells(PLACES, 2, 3) for cell in column]
    inside = torch.stack([cell.contains(PLACES) for cell in found])
    assert (inside.sum(dim=0) == 1).all()
    assert inside.sum(dim=1).min() > 160
    far = torch.tensor([[1e6, -1e6]], dtype=torch.float64)
    assert sum(bool(cell.contains(far)) for cell in found) == 1


@pytest.mark.parametrize("count", [1, 2, 17, 1000])
@pytest.mark.parametrize("parts", [2, 3, 50])
def test_cells_end_at_quantiles(count, parts):
    places = PLACES[:count]
    found = [column[0].high[0] for column in cells(places, 1, parts)]
    shares = torch.arange(1, parts, dtype=torch.float64) / parts
    expected = torch.quantile(places[:, 0], shares).unique().tolist()
    assert found == [*expected, math.inf]


def test_more_places_than_torch_finds_quantiles_of():
    count = 2**24 + 1
    places = torch.arange(count, dtype=torch.float64)[:, None].expand(count, 2)
    with pytest.raises(RuntimeError, match="too large"):
        places[:, 0].quantile(0.5)
    (low,), (high,) = cells(places, 1, 2)
    assert low.high[0] == high.low[0] == count // 2


def test_empty_cells_are_joined_with_their_neighbours():
    columns = cells(PLACES, 2, 3)
    bare = [*columns[0], columns[2][1]]
    shown = PLACES[~torch.stack([cell.contains(PLACES) for cell in bare]).any(dim=0)]
    kept = without_empty(columns, lambda cell: not cell.contains(shown).any())
    assert len(kept) == 3
    assert all(cell.contains(shown).any() for cell in kept)
    assert (torch.stack([cell.contains(PLACES) for cell in kept]).sum(dim=0) == 1).all()
    assert without_empty(columns, lambda cell: True) == [Region((-math.inf,) * 2, (math.inf,) * 2)]


def test_a_region_survives_json():
    region = Region((-math.inf, 1.5), (2.0, math.inf))
    assert Region.from_json(region.to_json()) == region


def test_the_plane_of_a_scene_holds_its_points(tmp_path):
    scene = load_scene(write_scene(tmp_path))
    plane = plane_of(scene)
    axes = torch.tensor(plane.axes)
    assert torch.allclose(axes @ axes.T, torch.eye(2, dtype=axes.dtype), atol=1e-6)
    assert plane.sides[0] > 0.5
    assert plane.sides[1] > 0.5


@pytest.mark.parametrize(
    ("count", "sides", "shape"),
    [(1, (1.0, 1.0), (1, 1)), (4, (2.0, 2.0), (2, 2)), (3, (90.0, 10.0), (1, 3))],
)
def test_cells_are_about_square(count, sides, shape):
    assert shape_for(count, sides) == shape


@pytest.mark.parametrize("text", ["2", "x3", "0x2", "2x-1", "axb", "1e3x2"])
def test_other_numbers_of_blocks_are_refused(text):
    with pytest.raises(ConfigError, match="blocks are auto, or ROWSxCOLUMNS such as 2x3"):
        parse_grid(text)


def test_numbers_of_blocks_are_read():
    assert parse_grid("auto") is None
    assert parse_grid("2x3") == (2, 3)
