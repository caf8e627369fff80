"""Start points, cleaned from a file."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from mrgs.data.sources import ReadingNotes
from mrgs.scene import PointCloud
from mrgs.scene.point_cloud import GREY


def point_cloud(
    positions: NDArray[np.float64],
    colors: NDArray[np.float64] | None,
    notes: ReadingNotes,
    transform: NDArray[np.float64] | None = None,
) -> PointCloud | None:
    """Points of a file, moved by ``transform`` ([3, 4]; None leaves them), without those that are
    not finite.

    Args:
        positions: [N, 3].
        colors: RGB in [0, 1], [N, 3]; None gives middle grey.
        notes: receives how many points were dropped.
        transform: an affine map to world coordinates.

    Returns:
        The points, None if none is left.
    """
    with np.errstate(all="ignore"):
        if transform is not None:
            positions = positions @ transform[:, :3].T + transform[:, 3]
        single = positions.astype(np.float32)
        # Squares must be finite too: distances between points are taken in float32.
        usable = np.isfinite(single * single).all(axis=1)
    if dropped := int((~usable).sum()):
        notes.repair(f"{dropped} start points are not finite; left out.")
    if not usable.any():
        return None
    rgb = (
        np.full(single.shape, GREY, dtype=np.float32)
        if colors is None
        else colors.astype(np.float32)
    )
    return PointCloud(torch.from_numpy(single[usable]), torch.from_numpy(rgb[usable]))
