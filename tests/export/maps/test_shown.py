"""The surface of a map where its far camera sees something else than the photos."""

from __future__ import annotations

import numpy as np
import pytest

from mrgs.export.maps.grid import MapGrid, unprojected
from mrgs.export.maps.photos import survey
from mrgs.export.maps.shown import ShownPlaces
from tests.export.maps.conftest import PIXEL

AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Right, up, and out of the wall."""

WHOLE = slice(0, 40), slice(0, 80)


@pytest.fixture(scope="module")
def maps(front, front_scene):
    return survey(front, front_scene)


def grid(low: float, high: float) -> MapGrid:
    """The wall's middle, 4 m wide and 2 m high, and what is drawn before and behind it."""
    return MapGrid(AXES, 1.0, np.zeros(2), -2.0, 3.5, PIXEL, 80, 40, (low, high))


def out_of_the_wall(drawn: MapGrid, found: np.ndarray) -> np.ndarray:
    return unprojected(drawn.camera(0, 0, 80, 40), found)[..., 1]


@pytest.mark.parametrize("wrong_m", [-1.5, 1.5, np.nan])
def test_what_no_photo_shows_gives_way_to_what_they_show(maps, wrong_m):
    """What floats before the wall, what lies behind it, and a gap."""
    drawn = grid(-1.0, 1.0)
    camera = drawn.camera(0, 0, 80, 40)
    depth = np.full((40, 80), -camera.position[1], np.float32)
    depth[10:30, 20:50] += wrong_m
    found = ShownPlaces(maps, drawn).depth_of_part(WHOLE, camera, depth)
    assert np.abs(out_of_the_wall(drawn, found)).max() < 0.05
    np.testing.assert_array_equal(found[:10], depth[:10])


def test_surfaces_that_the_map_does_not_draw_fill_nothing(maps):
    drawn = grid(0.5, 1.0)
    camera = drawn.camera(0, 0, 80, 40)
    nothing = np.full((40, 80), np.nan, np.float32)
    assert np.isnan(ShownPlaces(maps, drawn).depth_of_part(WHOLE, camera, nothing)).all()


def test_each_part_of_a_map_has_its_own_surface(maps):
    drawn = grid(-1.0, 1.0)
    shown = ShownPlaces(maps, drawn)
    nothing = np.full((40, 80), np.nan, np.float32)
    whole = shown.depth_of_part(WHOLE, drawn.camera(0, 0, 80, 40), nothing)
    part = slice(8, 40), slice(30, 80)
    found = shown.depth_of_part(part, drawn.camera(30, 8, 50, 32), nothing[part])
    np.testing.assert_allclose(found, whole[part], atol=0.05)
