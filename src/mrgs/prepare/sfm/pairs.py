"""Which images are matched with which."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from scipy.spatial import cKDTree

from mrgs.scene.similarity import fit_robustly

NEAREST = 20
MIN_SPREAD_M = 5.0
"""Root mean square distance from the middle. GPS cannot tell positions apart that are closer."""

MAX_MISFIT = 0.3
MIN_IMAGES = 8


def spread_m(positions: Float64[np.ndarray, "n 3"]) -> float:
    """Root mean square distance of the positions from their middle."""
    return float(np.sqrt(((positions - positions.mean(axis=0)) ** 2).sum(axis=1).mean()))


def are_informative(positions: Float64[np.ndarray, "n 3"] | None) -> bool:
    """Whether there are positions, and far enough from each other to mean something."""
    return (
        positions is not None
        and len(positions) >= MIN_IMAGES
        and spread_m(positions) >= MIN_SPREAD_M
    )


def pairs_nearby(positions: Float64[np.ndarray, "n 3"]) -> list[tuple[int, int]]:
    """Each image with the ``NEAREST`` that were taken closest to it."""
    _, nearest = cKDTree(positions).query(positions, range(1, min(NEAREST + 1, len(positions)) + 1))
    return _couples(nearest)


def _couples(others: Int64[np.ndarray, "n k"]) -> list[tuple[int, int]]:
    """Each image, by its row, with each of the others, once; the smaller number first."""
    rows = np.broadcast_to(np.arange(len(others))[:, None], others.shape)
    couples = np.sort(np.stack([rows, others], axis=-1)[rows != others], axis=1)
    return [(int(first), int(second)) for first, second in np.unique(couples, axis=0)]


def misfit(centres: Float64[np.ndarray, "n 3"], positions: Float64[np.ndarray, "n 3"]) -> float:
    """How far cameras are off their positions, which nine of ten do not exceed, as a share of the
    positions' spread; ``centres`` are in any world."""
    moved = fit_robustly(centres, positions).similarity(centres)
    off = np.linalg.norm(moved - positions, axis=1)
    return float(np.quantile(off, 0.9)) / max(spread_m(positions), 1e-9)


MAX_EXHAUSTIVE = 100
"""All pairs of more images take too long: a pair takes a tenth of a second on two cores."""

NEIGHBOURS = 10
ALIKE = 20
WORDS = 64
_SAMPLES = 50_000
_ITERATIONS = 10


def pairs_to_match(
    count: int,
    descriptors: Callable[[], list[UInt8[np.ndarray, "_ d"]]],
    positions: Float64[np.ndarray, "n 3"] | None = None,
) -> list[tuple[int, int]]:
    """All pairs of a small set; else each image with those taken nearest to it, or where that is
    not known, with those taken before and after it and those most like it. Images are numbered in
    the order in which they were taken; ``descriptors`` are only read where likeness decides."""
    if count <= MAX_EXHAUSTIVE:
        return list(combinations(range(count), 2))
    if positions is not None and are_informative(positions):
        return pairs_nearby(positions)
    signatures = image_signatures(descriptors())
    likeness = signatures @ signatures.T
    np.fill_diagonal(likeness, -np.inf)
    alike = np.argsort(-likeness, axis=1, kind="stable")[:, :ALIKE]
    after = np.minimum(np.arange(count)[:, None] + np.arange(1, NEIGHBOURS + 1), count - 1)
    return _couples(np.hstack([alike, after]))


def image_signatures(descriptors: list[UInt8[np.ndarray, "_ d"]]) -> Float32[np.ndarray, "n f"]:
    """A unit vector for each image, whose product with another's measures their similarity: locally
    aggregated descriptors (Jégou et al., 2010) with normalised residuals (Arandjelović and
    Zisserman, 2013), of the images' own words in place of a vocabulary."""
    rng = np.random.default_rng(0)
    share = max(_SAMPLES // len(descriptors), 1)
    sample = np.concatenate([rng.permutation(own)[:share] for own in descriptors]).astype(
        np.float32
    )
    if len(sample) == 0:
        return np.zeros((len(descriptors), 1), dtype=np.float32)
    words = rng.permutation(sample)[:WORDS]
    for _ in range(_ITERATIONS):
        nearest = _nearest(sample, words)
        sums = np.stack([sample[nearest == word].sum(axis=0) for word in range(len(words))])
        counts = np.bincount(nearest, minlength=len(words))[:, None]
        words = np.where(counts > 0, sums / np.maximum(counts, 1), words).astype(np.float32)
    return np.stack([_signature(own.astype(np.float32), words) for own in descriptors])


def _signature(
    own: Float32[np.ndarray, "k d"], words: Float32[np.ndarray, "w d"]
) -> Float32[np.ndarray, " f"]:
    nearest = _nearest(own, words)
    residuals = np.stack(
        [(own[nearest == word] - words[word]).sum(axis=0) for word in range(len(words))]
    )
    residuals /= np.maximum(np.linalg.norm(residuals, axis=1, keepdims=True), 1e-12)
    return (residuals / max(float(np.linalg.norm(residuals)), 1e-12)).ravel()


def _nearest(own: Float32[np.ndarray, "k d"], words: Float32[np.ndarray, "w d"]) -> np.ndarray:
    """The word nearest to each descriptor."""
    return (own @ words.T - (words**2).sum(axis=1) / 2).argmax(axis=1)
