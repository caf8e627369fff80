from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrgs.prepare.pairs.clocks import clock_offset, match_times

TIMES = st.lists(st.integers(0, 60).map(lambda tenths: tenths / 10), max_size=5).map(sorted)


def best_by_trying(rgb: list[float], thermal: list[float], tolerance_s: float) -> tuple[int, float]:
    """The most pairs, and their smallest sum of squares, over all ways to pair."""
    best = (0, 0.0)
    for count in range(1, min(len(rgb), len(thermal)) + 1):
        for chosen in itertools.combinations(range(len(thermal)), count):
            for order in itertools.permutations(range(len(rgb)), count):
                apart = [rgb[i] - thermal[j] for i, j in zip(order, chosen, strict=True)]
                squares = -sum(value**2 for value in apart)
                if all(abs(value) <= tolerance_s for value in apart):
                    best = max(best, (count, squares))
    return best


@settings(max_examples=60)
@given(TIMES, TIMES, st.sampled_from([0.0, 0.5, 1.0, 2.0]))
def test_as_many_pairs_as_can_be_and_the_nearest(rgb, thermal, tolerance_s):
    pairs = match_times(rgb, thermal, tolerance_s)
    assert len({i for i, _ in pairs}) == len({j for _, j in pairs}) == len(pairs)
    assert all(abs(rgb[i] - thermal[j]) <= tolerance_s for i, j in pairs)
    count, squares = best_by_trying(rgb, thermal, tolerance_s)
    assert len(pairs) == count
    if count:
        assert -sum((rgb[i] - thermal[j]) ** 2 for i, j in pairs) == pytest.approx(
            squares, abs=1e-3
        )


def test_the_nearest_alone_would_lose_a_pair():
    """Greedily, 10.0 would take 9.9 and leave 8.5 without partner."""
    assert match_times([9.9, 11.5], [8.5, 10.0], 2.0) == [(0, 0), (1, 1)]


def test_photos_of_one_second_keep_their_order():
    assert match_times([5.0, 5.0, 5.0], [5.0, 5.0, 5.0], 2.0) == [(0, 0), (1, 1), (2, 2)]


@settings(max_examples=25)
@given(st.integers(-90_000, 90_000), st.integers(0, 1000))
def test_the_offset_of_two_clocks_is_found(offset_s, seed):
    rng = np.random.default_rng(seed)
    moments = np.cumsum(rng.uniform(4.0, 30.0, 25))
    thermal = moments[rng.random(25) < 0.9]
    rgb = np.sort(moments[rng.random(25) < 0.9] + offset_s + rng.uniform(-0.4, 0.4))
    found = clock_offset(rgb.tolist(), thermal.tolist(), 2.0)
    together = len(match_times((rgb - found.seconds).tolist(), thermal.tolist(), 2.0))
    assert together == found.pairs
    assert abs(found.seconds - offset_s) < 2.5


def test_clocks_that_agree_have_no_offset():
    times = [0.0, 7.0, 11.0, 30.0]
    assert clock_offset([time + 0.7 for time in times], times, 2.0).seconds == 0.0


@pytest.mark.parametrize(
    ("offset_s", "gaps_s", "found"), [(0, (3, 5), 30), (20, (18, 22), 25), (10, (8, 12), 25)]
)
def test_clocks_that_differ_by_an_interval_are_not_taken_for_in_step(offset_s, gaps_s, found):
    """Where all pairs would be shifted by one photo, what they are apart varies more; where that
    does not show in times of whole seconds, the other offset is named."""
    right = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        moments = np.cumsum(rng.uniform(*gaps_s, 20))
        rgb = np.floor(np.sort(moments + offset_s + rng.normal(0, 0.3, 20)))
        offset = clock_offset(rgb.tolist(), np.floor(moments).tolist(), 2.0)
        right += abs(offset.seconds - offset_s) < 1.5
        assert abs(offset.seconds - offset_s) < 1.5 or offset.rival is not None
    assert right >= found


def test_of_offsets_with_as_many_pairs_the_evener_one_is_taken():
    rng = np.random.default_rng(0)
    thermal = np.cumsum(5 + rng.uniform(-0.2, 0.2, 60))
    rgb = np.sort(rng.choice(thermal, 45, replace=False)) + 3
    assert clock_offset(rgb.tolist(), thermal.tolist(), 1.0).seconds == pytest.approx(3.0)


def test_photos_at_regular_times_may_be_shifted():
    thermal = [5.0 * index for index in range(12)]
    found = clock_offset([time + 1002.4 for time in thermal], thermal, 2.0)
    assert found.seconds == pytest.approx(1002.4)
    assert found.rival is not None
    assert found.rival.pairs == found.pairs - 1


def test_few_photos_prove_no_offset():
    assert clock_offset([500.0, 510.0], [0.0, 10.0], 2.0).seconds == 0.0
    assert clock_offset([], [], 2.0).pairs == 0
