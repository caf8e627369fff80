from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from mrgs.blocks.region import (
    Rectangle,
    Ring,
    ScenePlane,
    cells,
    parse_grid,
    plane_of,
    shape_for,
    without_empty,
)
from mrgs.data import load_scene
from mrgs.errors import ConfigError
from mrgs.scene import PointCloud, WorldFrame
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


@pytest.mark.slow
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
    assert without_empty(columns, lambda cell: True) == [
        Rectangle((-math.inf,) * 2, (math.inf,) * 2)
    ]


def test_an_empty_column_is_joined_with_the_one_before_it():
    columns = cells(PLACES, 2, 3)
    left, right = columns[1][0].low[0], columns[1][0].high[0]
    kept = without_empty(columns, lambda cell: cell.low[0] == left and cell.high[0] == right)
    assert [each.low[0] for each in kept] == [-math.inf, -math.inf, right, right]
    assert [each.high[0] for each in kept] == [right, right, math.inf, math.inf]


def test_what_reaches_out_of_a_region_does_not_lie_in_it_and_grows_with_its_margin():
    region = Rectangle((0.0, 0.0), (4.0, 2.0))
    places = torch.tensor([[0.5, 1.0], [3.5, 1.0], [2.0, 1.6], [2.0, 1.0]])
    reach = torch.tensor([0.6, 0.4, 0.6, 0.9])
    assert region.contains(places).all()
    assert region.contains(places, reach).tolist() == [False, True, False, True]
    grown = region.grown(0.5)
    assert grown == Rectangle((-0.5, -0.5), (4.5, 2.5))
    assert grown.contains(places, reach).all()


def test_a_ring_holds_what_reaches_neither_out_of_it_nor_into_its_hole():
    ring = Ring(Rectangle((-2.0, -2.0), (2.0, 2.0)), Rectangle((-1.0, -1.0), (1.0, 1.0)))
    places = torch.tensor([[1.5, 0.0], [1.1, 0.0], [0.9, 0.0], [0.0, -1.5]])
    assert ring.contains(places).tolist() == [True, True, False, True]
    reach = torch.tensor([0.4, 0.2, 0.2, 0.6])
    assert ring.contains(places, reach).tolist() == [True, False, False, False]


def test_a_region_counts_as_far_as_it_lies_in_the_scene():
    plane = ScenePlane(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), (-3.0, -1.0), (5.0, 2.0))
    assert plane.sides == (8.0, 3.0)
    endless = Rectangle((-math.inf, -math.inf), (1.0, math.inf))
    assert plane.clipped(endless) == (4.0, 3.0)
    assert plane.clipped(Rectangle((0.0, 0.0), (9.0, 1.0))) == (5.0, 1.0)


def test_where_the_horizontal_is_known_a_scene_is_cut_upright(tmp_path):
    """A tower: most of it spreads upwards."""
    scene = load_scene(write_scene(tmp_path))
    tower = torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [0.3, 0.2, 0.9]
    )
    scene = replace(scene, points=PointCloud(tower, torch.zeros(2000, 3)))
    assert abs(plane_of(scene).axes[0][2]) > 0.9
    north = replace(scene, world=WorldFrame(metric=True, north=True))
    for axis in plane_of(north).axes:
        assert axis[2] == pytest.approx(0.0, abs=1e-9)
        assert max(axis, key=abs) > 0


def test_a_region_survives_json():
    region = Rectangle((-math.inf, 1.5), (2.0, math.inf))
    assert Rectangle.from_json(region.to_json()) == region


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


@pytest.mark.parametrize("text", ["2", "x3", "0x2", "2x-1", "axb", "1e3x2", "101x100"])
def test_other_numbers_of_blocks_are_refused(text):
    with pytest.raises(ConfigError, match=r"auto, .*ROWSxCOLUMNS"):
        parse_grid(text)


def test_numbers_of_blocks_are_read():
    assert parse_grid("auto") is None
    assert parse_grid("2x3") == (2, 3)
    assert parse_grid("100x100") == (100, 100)
