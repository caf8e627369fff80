"""Which part of a map enough photos show."""

from __future__ import annotations

import numpy as np

from mrgs.export.maps.coverage import LEAST_SHARE, Coverage


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
        coverage.holds(u, np.array([0.0]))[0], [False, True, True, True, False]
    )


def test_a_hole_that_photos_show_badly_stays_in_the_map():
    places = square(-3, 3)
    ring = places[np.abs(places).max(axis=1) > 1.0]
    coverage = Coverage.of([ring] * 5, 0.25)
    middle = coverage.share.shape[0] // 2
    assert coverage.share[middle, middle] < LEAST_SHARE
    assert coverage.holds(np.arange(-2.5, 3, 0.5), np.arange(-2.5, 3, 0.5)).all()


def test_one_place_is_a_map():
    low, high = Coverage.of([np.array([[1.0, 2.0]])], 0.5).bounds
    assert (low <= [1.0, 2.0]).all()
    assert (high >= [1.0, 2.0]).all()
