"""GPS positions of a flight over rows that look alike."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrgs.prepare.sfm.pairs import (
    MAX_MISFIT,
    MIN_SPREAD_M,
    NEAREST,
    are_informative,
    misfit,
    pairs_nearby,
    spread_m,
)


def flight(lines: int = 6, along: int = 10) -> np.ndarray:
    """Photos every 4 m, in lines 3.5 m apart, 20 m above the ground."""
    return np.array([[4.0 * x, 3.5 * y, 20.0] for y in range(lines) for x in range(along)])


def in_another_world(centres: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    if np.linalg.det(rotation) < 0:
        rotation[0] *= -1
    turned: np.ndarray = rng.uniform(0.1, 3) * centres @ rotation.T + rng.normal(size=3)
    return turned


def test_pairs_are_of_photos_taken_near_each_other():
    positions = flight()
    pairs = pairs_nearby(positions)
    assert len(pairs) == len(set(pairs)) <= NEAREST * len(positions)
    assert all(first < second for first, second in pairs)
    distances = np.linalg.norm(positions[:, None] - positions, axis=2)
    for image in range(len(positions)):
        own = {sum(pair) - image for pair in pairs if image in pair}
        nearest = np.sort(distances[image])[NEAREST]
        assert set(np.flatnonzero(distances[image] < nearest)) - {image} <= own


def test_pairs_of_a_few_photos_are_all_pairs():
    assert pairs_nearby(flight(1, 3)) == [(0, 1), (0, 2), (1, 2)]


def test_pairs_of_photos_at_one_place():
    """As from phones that repeat their last position."""
    pairs = pairs_nearby(np.zeros((30, 3)))
    assert all(first < second for first, second in pairs)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_right_poses_fit_noisy_positions(seed):
    positions = flight() + np.random.default_rng(seed).normal(0, 1.0, (60, 3))
    assert misfit(in_another_world(flight(), seed), positions) < MAX_MISFIT


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), rows=st.sampled_from([2, 3]))
def test_rows_that_lie_on_each_other_do_not(seed, rows):
    """Lines over other rows of modules get the poses of lines over the first ones."""
    folded = flight()
    folded[:, 1] %= 3.5 * rows
    positions = flight() + np.random.default_rng(seed).normal(0, 0.5, (60, 3))
    assert misfit(in_another_world(folded, seed), positions) > MAX_MISFIT


def test_positions_that_are_too_close_together_or_unknown_do_not_count():
    around_a_table = flight() * MIN_SPREAD_M / spread_m(flight()) * 0.99
    assert are_informative(flight())
    assert not are_informative(around_a_table)
    assert not are_informative(flight()[:5])
    assert not are_informative(None)


def test_spread():
    assert spread_m(np.array([[0.0, 3, 0], [0, -3, 0]])) == pytest.approx(3)
