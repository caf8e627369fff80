"""Start points of the Gaussians, and how they are drawn where a capture has none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from mrgs.scene.camera import Camera

RANDOM_POINTS = 20_000

NEAREST, FARTHEST = 0.5, 4.0
"""Range of the random points' depths, as multiples of the depth at which the cameras look."""

GREY = 0.5
"""Grey of points whose colours are not known."""


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Start points of the Gaussians.

    Attributes:
        positions: in world coordinates, [N, 3].
        colors: RGB in [0, 1], [N, 3].
        random: whether they were drawn, and so say nothing of where surfaces are.
    """

    positions: Float32[Tensor, "n 3"]
    colors: Float32[Tensor, "n 3"]
    random: bool = False

    def __len__(self) -> int:
        return len(self.positions)

    def rows(self, rows: Int64[Tensor, " k"]) -> PointCloud:
        """Some of the points, in this order."""
        return PointCloud(self.positions[rows], self.colors[rows], self.random)

    def __repr__(self) -> str:
        return f"PointCloud({len(self):,} points)"


def random_points(cameras: Sequence[Camera], seed: int) -> PointCloud:
    """``RANDOM_POINTS`` grey points on the rays of random pixels of random cameras, at ``NEAREST``
    to ``FARTHEST`` times the depth at which the cameras look, uniform in 1/depth: they gather on an
    object, fill the space before a façade, and none is unseen."""
    generator = torch.Generator().manual_seed(seed)
    which = torch.randint(len(cameras), (RANDOM_POINTS,), generator=generator)
    unit = torch.rand(RANDOM_POINTS, 3, generator=generator, dtype=torch.float64)
    depth = _looking_depth(cameras) / (1 / NEAREST + unit[:, 2] * (1 / FARTHEST - 1 / NEAREST))
    positions = torch.empty(RANDOM_POINTS, 3, dtype=torch.float64)
    for number, camera in enumerate(cameras):
        own = which == number
        pixels = unit[own, :2] * torch.tensor([camera.width, camera.height])
        positions[own] = camera.unproject(pixels, depth[own])
    grey = torch.full((RANDOM_POINTS, 3), GREY, dtype=torch.float32)
    return PointCloud(positions.float(), grey, random=True)


def _looking_depth(cameras: Sequence[Camera]) -> float:
    """Mean depth of the point p nearest to all optical axes, which minimises Σ |(I − f fᵀ)(p − c)|²
    over centres c and directions f; the cameras' spread where these are almost parallel."""
    centre = torch.stack([camera.position for camera in cameras])
    forward = torch.stack([camera.forward for camera in cameras])
    spread = (centre - centre.mean(dim=0)).norm(dim=1).max().item()
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    normal = across.mean(dim=0)
    if torch.linalg.eigvalsh(normal)[0] > 0.01:  # the axes differ by some six degrees or more
        focus = torch.linalg.solve(normal, (across @ centre[..., None]).mean(dim=0))[:, 0]
        depth = ((focus - centre) * forward).sum(dim=1).mean().item()
        if depth > 0.1 * spread:
            return depth
    return 2 * spread if spread > 1e-6 else 1.0


CROWDED = 1_000
"""Largest number of coincident points that are still compared with each other."""


def coincident_points(
    points: Float64[np.ndarray, "n 3"], kept: int, most: int = CROWDED
) -> list[Int64[np.ndarray, "_"]]:
    """The indices of the points at each position that more than ``max(most, kept)`` of them share,
    all of which a k-d tree would compare with each other. ``kept`` is how many of a position the
    caller keeps, ``most`` how many are still fast."""
    most = max(most, kept)
    if np.unique(points[:, 0], return_counts=True)[1].max() <= most:  # much faster than all axes
        return []
    _, place, counts = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    by_place, ends = np.argsort(place.ravel(), kind="stable"), np.cumsum(counts)
    crowded = np.flatnonzero(counts > most)
    return [by_place[ends[each] - counts[each] : ends[each]] for each in crowded]


def spare_points(crowded: Sequence[Int64[np.ndarray, "_"]], kept: int) -> Int64[np.ndarray, " s"]:
    """All ``coincident_points`` but the first ``kept`` at each position."""
    return np.concatenate([np.empty(0, np.int64), *(crowd[kept:] for crowd in crowded)])
