"""Photos of two cameras paired by their times, and the offset between the two clocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.optimize import linear_sum_assignment

_AS_GOOD = 0.9
"""An offset with this share of another one's pairs is as good."""

_TRIED = 24
"""Number of the most frequent differences of two times that are tried as offsets."""

_LOOKED_AT = 50_000
"""Number of differences, the most frequent first, that are searched."""

_FEWEST = 3
"""Fewer pairs than this prove no offset."""

_CLOCK_S = 0.2
"""What clocks of whole seconds let the spread of what pairs are apart vary by, seconds."""

_RANK_S = 1e-5
"""Photos of the same second are ordered as if they were this far apart, seconds."""


@dataclass(frozen=True)
class ClockOffset:
    """Offset between the clocks of two cameras: time on the first minus time on the second, at the
    same moment; the number of pairs with this offset; and another one with nearly as many."""

    seconds: float
    pairs: int
    rival: ClockOffset | None = None


def match_times(
    first_s: Sequence[float], second_s: Sequence[float], tolerance_s: float
) -> list[tuple[int, int]]:
    """Pairs of indices of photos at most ``tolerance_s`` seconds apart, by ascending times on one
    clock: as many as possible, and then the nearest."""
    first, second = np.asarray(first_s, np.float64), np.asarray(second_s, np.float64)
    times = np.sort(np.concatenate([first, second]))
    starts = times[1:][np.diff(times) > tolerance_s]  # no pair bridges these gaps
    of_first, of_second = (np.searchsorted(starts, each, "right") for each in (first, second))
    pairs: list[tuple[int, int]] = []
    for cluster in np.intersect1d(of_first, of_second):
        rows, columns = np.flatnonzero(of_first == cluster), np.flatnonzero(of_second == cluster)
        apart = first[rows, None] - second[columns]
        near = np.abs(apart) <= tolerance_s
        # Squares keep the order where times are equal.
        order = np.arange(len(rows))[:, None] - np.arange(len(columns))
        cost = (apart + _RANK_S * order) ** 2
        forbidden = (1 + cost[near].max(initial=0.0)) * (1 + min(cost.shape))
        chosen = zip(*linear_sum_assignment(np.where(near, cost, forbidden)), strict=True)
        pairs += [(int(rows[i]), int(columns[j])) for i, j in chosen if near[i, j]]
    return sorted(pairs, key=lambda pair: pair[1])


def clock_offset(
    first_s: Sequence[float], second_s: Sequence[float], tolerance_s: float
) -> ClockOffset:
    """The clock offset with which most photos find a partner within ``tolerance_s`` seconds, by
    ascending times; 0 where that is nearly as good. What the pairs are apart must not vary by much
    more than with another offset, as it does where all are shifted by one photo."""
    first, second = np.asarray(first_s, np.float64), np.asarray(second_s, np.float64)
    smaller = min(len(first), len(second))
    if smaller < _FEWEST:
        return ClockOffset(0.0, len(_apart(first, second, tolerance_s)))
    windows_s = (0.5, max(tolerance_s, 0.5))
    tried = {s for window_s in windows_s for s in _frequent_differences(first, second, window_s)}
    tests = []
    for seconds in (0.0, *sorted(tried - {0.0})):
        apart = _apart(first - seconds, second, tolerance_s)
        spread = float(np.abs(apart - np.median(apart)).mean()) if len(apart) else np.inf
        tests.append((ClockOffset(seconds, len(apart)), spread))
    in_step = tests[0][0]
    most = max(one.pairs for one, _ in tests)
    if most < max(_FEWEST, smaller / 2):
        return in_step
    tests = [(one, spread) for one, spread in tests if one.pairs >= _AS_GOOD * most]
    highest = 2 * min(spread for _, spread in tests) + _CLOCK_S
    tests = [(one, spread) for one, spread in tests if spread <= highest]
    tests.sort(key=lambda each: (each[0] is not in_step, -each[0].pairs, each[1]))
    best = tests[0][0]
    far = [one for one, _ in tests if abs(one.seconds - best.seconds) > windows_s[1]]
    rival = max(far, key=lambda one: one.pairs, default=None)
    if rival is not None and best is in_step and rival.pairs <= best.pairs:
        rival = None  # clocks that may be in step are not doubted for less
    return ClockOffset(best.seconds, best.pairs, rival)


def _frequent_differences(
    first: Float64[np.ndarray, " m"], second: Float64[np.ndarray, " n"], window_s: float
) -> list[float]:
    """Centres of the windows with most of the differences between all times of the two cameras."""
    differences = np.sort((first[:, None] - second).ravel())
    ends = np.searchsorted(differences, differences + window_s, "right")
    counts = ends - np.arange(len(differences))
    centres: list[float] = []
    for start in np.argsort(-counts, kind="stable")[:_LOOKED_AT]:
        centre = float(differences[(start + ends[start]) // 2])  # the median, as they are sorted
        if all(abs(centre - other) > window_s / 2 for other in centres):
            centres.append(centre)
        if len(centres) == _TRIED:
            break
    return centres


def _apart(
    first: Float64[np.ndarray, " m"], second: Float64[np.ndarray, " n"], tolerance_s: float
) -> Float64[np.ndarray, " pairs"]:
    """How far apart the photos of as many pairs as there can be were taken: with sorted times,
    taking the first that fits is best."""
    i = j = 0
    found: list[float] = []
    ours, theirs = first.tolist(), second.tolist()
    while i < len(ours) and j < len(theirs):
        apart = ours[i] - theirs[j]
        if abs(apart) <= tolerance_s:
            i, j = i + 1, j + 1
            found.append(apart)
        elif apart < 0:
            i += 1
        else:
            j += 1
    return np.array(found)
