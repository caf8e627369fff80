"""GPS positions against look-alikes: which photos were taken near each other, and whether poses
agree with that.

Rows of solar modules or windows look alike. Photos of two of them match as well as photos of one,
and the rows then lie on each other in the model, with small reprojection errors.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from mrgs.prepare.similarity import fit_robustly

NEAREST = 20
MIN_SPREAD_M = 5.0
"""Root mean square distance from the middle. GPS cannot tell positions apart that are closer."""

MAX_MISFIT = 0.3
MIN_IMAGES = 8


def spread_m(positions: Float64[np.ndarray, "n 3"]) -> float:
    """Root mean square distance of the positions from their middle."""
    return float(np.sqrt(((positions - positions.mean(axis=0)) ** 2).sum(axis=1).mean()))


def tell_apart(positions: Float64[np.ndarray, "n 3"] | None) -> bool:
    """Whether there are positions, and far enough from each other to mean something."""
    return (
        positions is not None
        and len(positions) >= MIN_IMAGES
        and spread_m(positions) >= MIN_SPREAD_M
    )


def pairs_nearby(positions: Float64[np.ndarray, "n 3"]) -> list[tuple[int, int]]:
    """Each image with the ``NEAREST`` that were taken closest to it."""
    count = min(NEAREST + 1, len(positions))
    _, nearest = cKDTree(positions).query(positions, count)
    others = np.reshape(nearest, (len(positions), count)).tolist()
    return sorted(
        {
            (min(image, other), max(image, other))
            for image, row in enumerate(others)
            for other in row
            if other != image
        }
    )


def misfit(centres: Float64[np.ndarray, "n 3"], positions: Float64[np.ndarray, "n 3"]) -> float:
    """How far cameras are off their positions, which nine of ten do not exceed, as a share of the
    positions' spread.

    Args:
        centres: of the cameras, in any world.
        positions: of the same cameras, in metres.
    """
    moved = fit_robustly(centres, positions).similarity(centres)
    off = np.linalg.norm(moved - positions, axis=1)
    return float(np.quantile(off, 0.9)) / max(spread_m(positions), 1e-9)
