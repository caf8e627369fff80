"""Places at which very many points lie: a k-d tree cannot divide them, and would compare each with
all of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

CROWDED = 1_000
"""So many points at one place are still compared with each other."""


def crowds(
    points: Float64[np.ndarray, "n 3"], kept: int, most: int = CROWDED
) -> list[Int64[np.ndarray, "_"]]:
    """The points of each crowded place, in ascending order.

    Args:
        points: at least one.
        kept: a place with so few points is none.
        most: nor is one with so many.
    """
    most = max(most, kept)
    if np.unique(points[:, 0], return_counts=True)[1].max() <= most:  # much faster than all axes
        return []
    _, place, counts = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    by_place, ends = np.argsort(place.ravel(), kind="stable"), np.cumsum(counts)
    crowded = np.flatnonzero(counts > most)
    return [by_place[ends[each] - counts[each] : ends[each]] for each in crowded]


def spare_points(crowded: Sequence[Int64[np.ndarray, "_"]], kept: int) -> Int64[np.ndarray, " s"]:
    """The points of ``crowds`` but for the first ``kept`` of each."""
    return np.concatenate([np.empty(0, np.int64), *(crowd[kept:] for crowd in crowded)])
