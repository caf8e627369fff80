"""The k nearest neighbours by a k-d tree (SciPy)."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from scipy.spatial import cKDTree
from torch import Tensor

CROWDED = 1_000
"""Of more points than this at one place, few are put into the tree: it cannot divide them, and
would compare each with all of them."""


def nearest_neighbours(means: Float[Tensor, "n 3"], k: int) -> Int64[Tensor, "n {k}"]:
    """``mrgs.field.heat.nearest_neighbours``, on the host whatever the device."""
    points = means.detach().to("cpu", torch.float64).numpy()
    count = len(points)
    itself = np.arange(count, dtype=np.int64)[:, None]
    found = max(min(k, count - 1), 0)
    padding = np.broadcast_to(itself, (count, k - found))
    if found == 0:
        return torch.tensor(padding, device=means.device)
    others = _nearest(points, found)
    return torch.from_numpy(np.concatenate([others, padding], axis=1)).to(means.device)


def _nearest(points: Float64[np.ndarray, "n 3"], k: int) -> Int64[np.ndarray, "n {k}"]:
    """The k nearest other points of each, k < n."""
    spare = _spare_members(points, k)
    if not spare:
        return _nearest_in_tree(points, k)
    kept = np.delete(np.arange(len(points)), np.concatenate([each for each, _ in spare]))
    index = np.empty((len(points), k), np.int64)
    index[kept] = kept[_nearest_in_tree(points[kept], k)]
    for members, nearest in spare:
        index[members] = nearest
    return index


def _spare_members(
    points: Float64[np.ndarray, "n 3"], k: int
) -> list[tuple[Int64[np.ndarray, " m"], Int64[np.ndarray, " {k}"]]]:
    """Of each crowded place, the points that nobody needs as a neighbour, and k others there."""
    most = max(CROWDED, k + 1)
    if np.unique(points[:, 0], return_counts=True)[1].max() <= most:
        return []
    _, place, counts = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    by_place, ends = np.argsort(place.ravel(), kind="stable"), np.cumsum(counts)
    crowds = [
        by_place[ends[each] - counts[each] : ends[each]] for each in np.flatnonzero(counts > most)
    ]
    return [(crowd[k + 1 :], crowd[:k]) for crowd in crowds]


def _nearest_in_tree(points: Float64[np.ndarray, "n 3"], k: int) -> Int64[np.ndarray, "n {k}"]:
    """``_nearest`` by a k-d tree of all points."""
    tree = cKDTree(points, balanced_tree=False)
    index = np.empty((len(points), k + 1), np.int64)
    # Neighbours in the tree are near each other in memory: a quarter of the time saved.
    order = tree.indices
    index[order] = tree.query(points[order], k=k + 1, workers=-1)[1]
    is_other = index != np.arange(len(points))[:, None]
    # Among coincident points the search may miss the Gaussian itself: then the farthest one goes
    # instead.
    is_other[is_other.all(axis=1), -1] = False
    return index[is_other].reshape(len(points), k)
