"""Photos of two cameras by their times: the offset between the clocks, and which photos match."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.optimize import linear_sum_assignment

_NEARLY = 0.9
"""An offset with this share of another one's pairs is as good."""

_TRIED = 24
"""Number of the most frequent differences of two times that are tried as offsets."""

_LOOKED_AT = 50_000
"""Number of differences, the most frequent first, that are searched."""

_FEWEST = 3
"""Fewer pairs than this prove no offset."""

_RANK_S = 1e-5
"""Photos of the same second are ordered as if they were this far apart, seconds."""


@dataclass(frozen=True)
class ClockOffset:
    """Offset between the clocks of two cameras: time on the first minus time on the second, at the
    same moment; the number of pairs with this offset; and another one with nearly as many, None if
    there is none."""

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
    ascending times; 0 where that is nearly as good."""
    first, second = np.asarray(first_s, np.float64), np.asarray(second_s, np.float64)
    in_step = ClockOffset(0.0, _count(first, second, tolerance_s))
    smaller = min(len(first), len(second))
    if smaller < _FEWEST or in_step.pairs >= _NEARLY * smaller:
        return in_step
    window_s = max(tolerance_s, 0.5)
    tried = _frequent_differences(first, second, window_s)
    found = sorted(
        (ClockOffset(s, _count(first - s, second, tolerance_s)) for s in tried),
        key=lambda one: -one.pairs,
    )
    best = found[0]
    if best.pairs < max(_FEWEST, smaller / 2) or in_step.pairs >= _NEARLY * best.pairs:
        return in_step
    others = [one for one in found[1:] if abs(one.seconds - best.seconds) > 2 * window_s]
    rival = others[0] if others and others[0].pairs >= _NEARLY * best.pairs else None
    return ClockOffset(best.seconds, best.pairs, rival)


def _frequent_differences(
    first: Float64[np.ndarray, " m"], second: Float64[np.ndarray, " n"], window_s: float
) -> list[float]:
    """The centres of the windows that hold most of the differences between all times of the two
    cameras."""
    differences = np.sort((first[:, None] - second).ravel())
    ends = np.searchsorted(differences, differences + window_s, "right")
    counts = ends - np.arange(len(differences))
    centres: list[float] = []
    for start in np.argsort(-counts, kind="stable")[:_LOOKED_AT]:
        centre = float(np.median(differences[start : ends[start]]))
        if all(abs(centre - other) > window_s / 2 for other in centres):
            centres.append(centre)
        if len(centres) == _TRIED:
            break
    return centres


def _count(
    first: Float64[np.ndarray, " m"], second: Float64[np.ndarray, " n"], tolerance_s: float
) -> int:
    """How many pairs there can be: with sorted times, taking the first that fits is best."""
    i = j = pairs = 0
    while i < len(first) and j < len(second):
        apart = first[i] - second[j]
        if abs(apart) <= tolerance_s:
            i, j, pairs = i + 1, j + 1, pairs + 1
        elif apart < 0:
            i += 1
        else:
            j += 1
    return pairs
