"""Which part of a map enough photos show, and the gaps between splats."""

from __future__ import annotations

import numpy as np

from mrgs.export.maps.coverage import LEAST_SHARE, Coverage
from mrgs.export.maps.draw import GAP_PX, _without_gaps


def square(low: float, high: float, step: float = 0.1) -> np.ndarray:
    middles = np.arange(low + step / 2, high, step)
    return np.stack([axis.ravel() for axis in np.meshgrid(middles, middles)], axis=1)


def test_a_map_ends_where_few_photos_look():
    """Ten photos of a roof, 6 m wide; one of them also shows 20 m of ground about it."""
    photos = [square(-3, 3)] * 9 + [square(-10, 10)]
    coverage = Coverage.of(photos, 0.25)
    low, high = coverage.bounds
    np.testing.assert_allclose([*low, *high], [-3, -3, 3, 3], atol=1)
    u = np.array([-9.0, -3.2, 0.0, 2.9, 5.0])
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


def test_narrow_gaps_take_the_depth_beside_them_and_wide_ones_stay():
    depth = np.full((30, 40), 5.0, np.float32)
    depth[:, 10 : 10 + 2 * GAP_PX] = np.nan
    depth[:, 20:30] = np.nan
    filled = _without_gaps(depth)
    assert (filled[:, :20] == 5).all()
    assert np.isnan(filled[:, 20:30]).all()
    assert (filled[:, 30:] == 5).all()
    assert np.isnan(_without_gaps(np.full((4, 4), np.nan, np.float32))).all()
