"""Which part of a map enough photos show, and where its pixels lie."""

from __future__ import annotations

import numpy as np

from mrgs.maps.surfaces import LEAST_SHARE, Coverage, MapGrid, unprojected
from mrgs.scene.depth_map import ENOUGH


def square(low: float, high: float, step: float = 0.1) -> np.ndarray:
    middles = np.arange(low + step / 2, high, step)
    return np.stack([axis.ravel() for axis in np.meshgrid(middles, middles)], axis=1)


def test_a_map_ends_where_few_photos_look():
    """Ten photos of a roof, 6 m wide; one of them also shows 20 m of ground about it."""
    photos = [square(-3, 3)] * 9 + [square(-10, 10)]
    coverage = Coverage.of(photos, 0.25)
    low, high = coverage.bounds
    np.testing.assert_allclose([*low, *high], [-3, -3, 3, 3], atol=1)
    np.testing.assert_allclose(low, -high)
    u = np.array([-9.0, -2.8, 0.0, 2.8, 5.0])
    np.testing.assert_array_equal(
        coverage.covers(u, np.array([0.0]))[0], [False, True, True, True, False]
    )


def test_both_edges_of_a_map_lie_alike():
    coverage = Coverage.of([square(-3, 3)] * 5, 0.25)
    places = np.linspace(-4, 4, 161)
    across = coverage.covers(places, np.array([0.0]))[0]
    np.testing.assert_array_equal(across, across[::-1])
    down = coverage.covers(np.array([0.0]), places)[:, 0]
    np.testing.assert_array_equal(down, across)
    assert 5.5 < across.sum() * 0.05 < 6.5


def test_a_hole_that_photos_show_badly_stays_in_the_map():
    places = square(-3, 3)
    ring = places[np.abs(places).max(axis=1) > 1.0]
    coverage = Coverage.of([ring] * 5, 0.25)
    middle = coverage.share.shape[0] // 2
    assert coverage.share[middle, middle] < LEAST_SHARE
    assert coverage.covers(np.arange(-2.5, 3, 0.5), np.arange(-2.5, 3, 0.5)).all()


def test_a_map_by_chosen_photos_has_no_bays_where_few_of_them_look():
    """By so few photos as all places are chosen for, beside what many show."""
    photos = [square(-3, 0)] * 20 + [square(-3, 3)] * ENOUGH
    low, high = Coverage.of(photos, 0.25, ENOUGH).bounds
    np.testing.assert_allclose([*low, *high], [-3, -3, 3, 3], atol=0.5)
    np.testing.assert_allclose(Coverage.of(photos, 0.25).bounds[1], 0, atol=0.6)


def test_one_place_is_a_map():
    low, high = Coverage.of([np.array([[1.0, 2.0]])], 0.5).bounds
    assert (low <= [1.0, 2.0]).all()
    assert (high >= [1.0, 2.0]).all()


def test_the_pixels_of_a_part_lie_where_those_of_the_whole_map_do():
    axes = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    grid = MapGrid(axes, 2.0, np.array([10.0, 20.0]), 30.0, 40.0, 0.5, 12, 8, (-1.0, 1.0))
    column, row, width, height = 5, 2, 4, 3
    camera = grid.camera(column, row, width, height)
    depth = np.full((height, width), 1000.0 * 0.25 * 12)  # of the middle of the slab
    points = unprojected(camera, depth)
    np.testing.assert_allclose(points @ axes[2], 0.0, atol=1e-6)
    u, v = grid.middles
    assert (u[0], v[0]) == (30.25, 39.75)
    there = np.stack(np.meshgrid(u[column:][:width], v[row:][:height]), axis=-1)
    found = grid.to_map(points.reshape(-1, 3)).reshape(height, width, 2)
    np.testing.assert_allclose(found, there, atol=1e-6)
    rows, columns = grid.window_of(points.reshape(-1, 3))
    assert (rows, columns) == (slice(2, 5), slice(5, 9))
