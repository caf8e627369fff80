"""The surface of a map where its far camera sees something else than the photos."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mrgs.maps.surfaces import MapGrid, ShownPlaces, _depth_of_cells, seen_surfaces, unprojected
from mrgs.scene import Camera
from tests.maps.conftest import PIXEL

AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Right, up, and out of the wall."""

WHOLE = slice(0, 40), slice(0, 80)


@pytest.fixture(scope="module")
def maps(front, front_scene):
    return seen_surfaces(front, front_scene)


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


def test_a_part_keeps_the_same_surfaces_as_the_whole_map(maps):
    drawn = grid(-1.0, 1.0)
    shown = ShownPlaces(maps, drawn)
    camera = drawn.camera(0, 0, 80, 40)
    depth = np.full((40, 80), -camera.position[1], np.float32)
    depth[10:20, 40:60] += 1.5  # behind the wall
    whole = shown.depth_of_part(WHOLE, camera, depth)
    part = slice(8, 40), slice(30, 80)
    found = shown.depth_of_part(part, drawn.camera(30, 8, 50, 32), depth[part])
    kept = whole[part] == depth[part]
    assert 0.5 < kept.mean() < 0.95
    np.testing.assert_array_equal(found == depth[part], kept)


def test_a_cell_has_the_median_of_its_depths():
    camera = Camera.from_fov(4, 4, 90)
    places = torch.tensor([[1.0, 1.0], [1.5, 1.5], [0.5, 1.0], [3.0, 1.0], [3.0, 1.2]]).double()
    points = camera.unproject(places, torch.tensor([9.0, 2.0, 3.0, 5.0, 5.0]).double()).numpy()
    wanted = np.zeros((4, 4), bool)
    wanted[1, [0, 3]] = wanted[3, 1] = True
    found = _depth_of_cells(camera, np.split(points, [2]), 2, wanted)
    np.testing.assert_allclose(found[:2, :2], 3.0)
    assert np.isnan(found[:, 2:]).all()  # of two points no surface is made
    assert np.isnan(found[2:]).all()
    wanted[1, 0] = False
    assert np.isnan(_depth_of_cells(camera, [points], 2, wanted)).all()


def test_the_camera_of_a_part_sees_the_part_s_pixels():
    drawn = grid(-1.0, 1.0)
    u, v = (axis.ravel() for axis in np.meshgrid(*drawn.middles))
    points = torch.from_numpy(np.stack([u, np.zeros_like(u), v], axis=1))
    columns, rows = (axis.ravel() + 0.5 for axis in np.meshgrid(np.arange(80), np.arange(40)))
    for column, row, width, height in ((0, 0, 80, 40), (30, 8, 50, 32)):
        pixels, _ = drawn.camera(column, row, width, height).project(points)
        expected = np.stack([columns - column, rows - row], axis=1)
        np.testing.assert_allclose(pixels, expected, atol=1e-6)
