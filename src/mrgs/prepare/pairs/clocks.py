"""Photos of two cameras by their times: how far apart the clocks are, and who belongs to whom."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.optimize import linear_sum_assignment

_NEARLY = 0.9
"""An offset that pairs so large a part of what another one pairs is as good as it."""

_TRIED = 24
"""So many of the most frequent differences of two times are tried as offsets."""

_LOOKED_AT = 50_000
"""Of the differences sorted by frequency, so many are looked through for those."""

_FEWEST = 3
"""Fewer pairs than this prove no offset."""

_RANK_S = 1e-5
"""Photos of the same second are told apart by their order, as if so far apart."""


@dataclass(frozen=True)
class ClockOffset:
    """How far the RGB camera's clock is ahead.

    Attributes:
        seconds: RGB camera's time minus thermal camera's time of the same moment.
        pairs: how many pairs it gives.
        rival_s: another offset that gives nearly as many; None if there is none.
    """

    seconds: float
    pairs: int
    rival_s: float | None = None


def match_times(
    rgb_s: Sequence[float], thermal_s: Sequence[float], tolerance_s: float
) -> list[tuple[int, int]]:
    """Pairs of indices, at most ``tolerance_s`` seconds apart: as many as can be, and then the
    nearest.

    Args:
        rgb_s: times, ascending.
        thermal_s: times on the same clock, ascending.
        tolerance_s: seconds.
    """
    rgb, thermal = np.asarray(rgb_s, np.float64), np.asarray(thermal_s, np.float64)
    pairs: list[tuple[int, int]] = []
    for first, second in _clusters(rgb, thermal, tolerance_s):
        pairs += _assign(rgb, thermal, first, second, tolerance_s)
    return sorted(pairs, key=lambda pair: pair[1])


def _clusters(
    rgb: Float64[np.ndarray, " r"], thermal: Float64[np.ndarray, " t"], tolerance_s: float
) -> list[tuple[Int64[np.ndarray, " a"], Int64[np.ndarray, " b"]]]:
    """Indices of photos between which there are gaps that no pair bridges."""
    times = np.sort(np.concatenate([rgb, thermal]))
    if len(rgb) == 0 or len(thermal) == 0:
        return []
    starts = times[1:][np.diff(times) > tolerance_s]
    of_rgb, of_thermal = (
        np.searchsorted(starts, rgb, "right"),
        np.searchsorted(starts, thermal, "right"),
    )
    both = np.intersect1d(of_rgb, of_thermal)
    return [
        (np.flatnonzero(of_rgb == cluster), np.flatnonzero(of_thermal == cluster))
        for cluster in both
    ]


def _assign(
    rgb: Float64[np.ndarray, " r"],
    thermal: Float64[np.ndarray, " t"],
    first: Int64[np.ndarray, " a"],
    second: Int64[np.ndarray, " b"],
    tolerance_s: float,
) -> list[tuple[int, int]]:
    """The best pairs within one cluster. Squares keep the order where times are equal."""
    apart = rgb[first, None] - thermal[second]
    ranks = _RANK_S * (np.arange(len(first))[:, None] - np.arange(len(second)))
    near = np.abs(apart) <= tolerance_s
    cost = (apart + ranks) ** 2
    forbidden = (1 + cost[near].max(initial=0.0)) * (1 + min(cost.shape))
    rows, columns = linear_sum_assignment(np.where(near, cost, forbidden))
    return [
        (int(first[i]), int(second[j])) for i, j in zip(rows, columns, strict=True) if near[i, j]
    ]


def clock_offset(
    rgb_s: Sequence[float], thermal_s: Sequence[float], tolerance_s: float
) -> ClockOffset:
    """The offset of the clocks with which most photos find a partner: none, where that is nearly as
    good.

    Args:
        rgb_s: times by the RGB camera's clock, ascending.
        thermal_s: times by the thermal camera's clock, ascending.
        tolerance_s: seconds that a pair's photos may be apart.
    """
    rgb, thermal = np.asarray(rgb_s, np.float64), np.asarray(thermal_s, np.float64)
    in_step = ClockOffset(0.0, _count(rgb, thermal, tolerance_s))
    smaller = min(len(rgb), len(thermal))
    if smaller < _FEWEST or in_step.pairs >= _NEARLY * smaller:
        return in_step
    window_s = max(tolerance_s, 0.5)
    tried = _frequent_differences(rgb, thermal, window_s)
    found = sorted(
        (ClockOffset(s, _count(rgb - s, thermal, tolerance_s)) for s in tried),
        key=lambda one: -one.pairs,
    )
    best = found[0]
    if best.pairs < max(_FEWEST, smaller / 2) or in_step.pairs >= _NEARLY * best.pairs:
        return in_step
    others = [one for one in found[1:] if abs(one.seconds - best.seconds) > 2 * window_s]
    rival = others[0].seconds if others and others[0].pairs >= _NEARLY * best.pairs else None
    return ClockOffset(best.seconds, best.pairs, rival)


def _frequent_differences(
    rgb: Float64[np.ndarray, " r"], thermal: Float64[np.ndarray, " t"], window_s: float
) -> list[float]:
    """The centres of the windows that hold most of the differences of all RGB times to all thermal
    times."""
    differences = np.sort((rgb[:, None] - thermal).ravel())
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
    rgb: Float64[np.ndarray, " r"], thermal: Float64[np.ndarray, " t"], tolerance_s: float
) -> int:
    """How many pairs there can be: with sorted times, taking the first that fits is best."""
    i = j = pairs = 0
    while i < len(rgb) and j < len(thermal):
        apart = rgb[i] - thermal[j]
        if abs(apart) <= tolerance_s:
            i, j, pairs = i + 1, j + 1, pairs + 1
        elif apart < 0:
            i += 1
        else:
            j += 1
    return pairs
