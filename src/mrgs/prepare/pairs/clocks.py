"""Photos of two cameras by their times: the offset between the clocks, and which photos match."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
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
    """Offset between the clocks of two cameras.

    Attributes:
        seconds: time on the first clock minus time on the second, at the same moment.
        pairs: number of pairs with this offset.
        rival_s: another offset with nearly as many pairs; None if there is none.
    """

    seconds: float
    pairs: int
    rival_s: float | None = None


def match_times(
    first_s: Sequence[float], second_s: Sequence[float], tolerance_s: float
) -> list[tuple[int, int]]:
    """Pairs of indices at most ``tolerance_s`` seconds apart: as many as possible, and then the
    nearest.

    Args:
        first_s: times of the first camera's photos, seconds, ascending.
        second_s: times of the second camera's photos on the same clock, seconds, ascending.
        tolerance_s: largest time difference within a pair, seconds.
    """
    first, second = np.asarray(first_s, np.float64), np.asarray(second_s, np.float64)
    pairs: list[tuple[int, int]] = []
    for rows, columns in _clusters(first, second, tolerance_s):
        pairs += _assign(first, second, rows, columns, tolerance_s)
    return sorted(pairs, key=lambda pair: pair[1])


def _clusters(
    first: Float64[np.ndarray, " m"], second: Float64[np.ndarray, " n"], tolerance_s: float
) -> list[tuple[Int64[np.ndarray, " a"], Int64[np.ndarray, " b"]]]:
    """Indices of photos between which there are gaps that no pair bridges."""
    times = np.sort(np.concatenate([first, second]))
    if len(first) == 0 or len(second) == 0:
        return []
    starts = times[1:][np.diff(times) > tolerance_s]
    of_first, of_second = (
        np.searchsorted(starts, first, "right"),
        np.searchsorted(starts, second, "right"),
    )
    both = np.intersect1d(of_first, of_second)
    return [
        (np.flatnonzero(of_first == cluster), np.flatnonzero(of_second == cluster))
        for cluster in both
    ]


def _assign(
    first: Float64[np.ndarray, " m"],
    second: Float64[np.ndarray, " n"],
    rows: Int64[np.ndarray, " a"],
    columns: Int64[np.ndarray, " b"],
    tolerance_s: float,
) -> list[tuple[int, int]]:
    """The best pairs within one cluster. Squares keep the order where times are equal."""
    apart = first[rows, None] - second[columns]
    ranks = _RANK_S * (np.arange(len(rows))[:, None] - np.arange(len(columns)))
    near = np.abs(apart) <= tolerance_s
    cost = (apart + ranks) ** 2
    forbidden = (1 + cost[near].max(initial=0.0)) * (1 + min(cost.shape))
    chosen = zip(*linear_sum_assignment(np.where(near, cost, forbidden)), strict=True)
    return [(int(rows[i]), int(columns[j])) for i, j in chosen if near[i, j]]


def clock_offset(
    first_s: Sequence[float], second_s: Sequence[float], tolerance_s: float
) -> ClockOffset:
    """The clock offset with which most photos find a partner; 0 where that is nearly as good.

    Args:
        first_s: times on the first camera's clock, seconds, ascending.
        second_s: times on the second camera's clock, seconds, ascending.
        tolerance_s: largest time difference within a pair, seconds.
    """
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
    rival = others[0].seconds if others and others[0].pairs >= _NEARLY * best.pairs else None
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
