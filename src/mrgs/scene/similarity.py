"""The similarity between two sets of corresponding points: by least squares, and robustly."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float64

Points: TypeAlias = Float64[np.ndarray, "n d"]

TRIALS = 500
_OUTLIER_MEDIANS = 2.5
_REFITS = 5


@dataclass(frozen=True, eq=False)
class Similarity:
    """y = scale · rotation x + translation, in d = 2 or 3 dimensions."""

    scale: float
    rotation: Float64[np.ndarray, "d d"]
    translation: Float64[np.ndarray, " d"]

    def __call__(self, points: Points) -> Points:
        """The points under the similarity [N, d]."""
        return self.scale * np.einsum("ij,nj->ni", self.rotation, points) + self.translation


@dataclass(frozen=True, eq=False)
class RobustFit:
    """A similarity that was fitted to the inliers, the standard deviation of their coordinates in
    units of the target, and their degrees of freedom: coordinates minus fitted numbers, at least
    1."""

    similarity: Similarity
    inliers: Bool[np.ndarray, " n"]
    sigma: float
    freedom: int


def fit_similarity(source: Points, target: Points) -> Similarity:
    """The least-squares similarity from source to target points (Umeyama, 1991)."""
    scales, rotations, translations = _umeyama(source[None], target[None])
    return Similarity(float(scales[0]), rotations[0], translations[0])


def fit_robustly(source: Points, target: Points) -> RobustFit:
    """Least median of squares over random triples, then least squares over the inliers (Rousseeuw
    and Leroy, 1987): deterministic, with up to almost half of the points outliers."""
    count, dimensions = source.shape
    best = _least_median(source, target)
    rounding = 1e-9 * float(np.abs(target - target.mean(axis=0)).max())
    inliers = np.ones(count, dtype=bool)
    for _ in range(_REFITS):
        distances = np.linalg.norm(best(source) - target, axis=1)
        typical = np.median(distances) * (1 + 5 / max(count - 3, 1))  # triples fit themselves
        inliers = distances <= max(_OUTLIER_MEDIANS * typical, rounding)
        best = fit_similarity(source[inliers], target[inliers])
    squares = ((best(source[inliers]) - target[inliers]) ** 2).sum()
    freedom = max(dimensions * int(inliers.sum()) - (dimensions * (dimensions + 1) // 2 + 1), 1)
    return RobustFit(best, inliers, math.sqrt(squares / freedom), freedom)


def _least_median(source: Points, target: Points) -> Similarity:
    """The one of ``TRIALS`` random triples, or of all points, with the least median distance."""
    order = np.random.default_rng(0).random((TRIALS, len(source))).argsort(axis=1)[:, :3]
    fits = _umeyama(source[order], target[order]), _umeyama(source[None], target[None])
    scales, rotations, translations = (np.concatenate(parts) for parts in zip(*fits, strict=True))
    moved = scales[:, None, None] * np.einsum("tij,nj->tni", rotations, source)
    off = np.linalg.norm(moved + translations[:, None] - target, axis=2)
    best = np.median(off, axis=1).argmin()
    return Similarity(float(scales[best]), rotations[best], translations[best])


def _umeyama(
    source: Float64[np.ndarray, "t n d"], target: Float64[np.ndarray, "t n d"]
) -> tuple[Float64[np.ndarray, " t"], Float64[np.ndarray, "t d d"], Float64[np.ndarray, "t d"]]:
    """Scale, rotation and translation of least-squares similarities."""
    source_mean, target_mean = source.mean(axis=-2), target.mean(axis=-2)
    centred = source - source_mean[..., None, :]
    covariance = np.einsum("...ni,...nj->...ij", target - target_mean[..., None, :], centred)
    left, singular, right = np.linalg.svd(covariance)
    signs = np.ones_like(singular)
    signs[..., -1] = np.sign(np.linalg.det(left) * np.linalg.det(right))
    rotation = np.einsum("...ij,...j,...jk->...ik", left, signs, right)
    scale = (singular * signs).sum(axis=-1) / np.maximum((centred**2).sum(axis=(-2, -1)), 1e-300)
    moved = scale[..., None] * np.einsum("...ij,...j->...i", rotation, source_mean)
    return scale, rotation, target_mean - moved
