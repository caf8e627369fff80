"""The k nearest neighbours by a k-d tree (SciPy)."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from scipy.spatial import cKDTree
from torch import Tensor

from mrgs.scene.point_cloud import coincident_points, spare_points


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
    """The k nearest other points of each, k < n. At a crowded place nobody needs more than k + 1
    points: the others there have the first k as their neighbours."""
    crowded = coincident_points(points, k + 1)
    if not crowded:
        return _nearest_in_tree(points, k)
    kept = np.delete(np.arange(len(points)), spare_points(crowded, k + 1))
    index = np.empty((len(points), k), np.int64)
    index[kept] = kept[_nearest_in_tree(points[kept], k)]
    for crowd in crowded:
        index[crowd[k + 1 :]] = crowd[:k]
    return index


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
