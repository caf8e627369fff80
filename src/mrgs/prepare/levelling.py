"""The up direction, estimated from how the cameras were held."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Float64

from mrgs.prepare.contract import Reconstruction
from mrgs.prepare.similarity import Similarity

_MEAN_WEIGHT = 0.05


def centres(reconstruction: Reconstruction, names: Iterable[str]) -> Float64[np.ndarray, "n 3"]:
    """Camera centres of views [N, 3], in the world of the reconstruction."""
    viewmats = np.stack([reconstruction.viewmats[name].numpy() for name in names])
    return -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])


def levelled(reconstruction: Reconstruction) -> Similarity:
    """The similarity to a world with z up, y along the mean viewing direction, and the origin at
    the median of the points; the scale is kept."""
    up = up_of_cameras(reconstruction)
    forward = _axes(reconstruction)[:, 2].mean(axis=0)
    ahead = forward - (forward * up).sum() * up
    if np.linalg.norm(ahead) < 1e-3:  # all look straight down, or around in a circle
        ahead = np.eye(3)[np.abs(up).argmin()]
        ahead = ahead - (ahead * up).sum() * up
    ahead = ahead / np.linalg.norm(ahead)
    rotation = np.stack([np.cross(ahead, up), ahead, up])
    points = reconstruction.points.positions.double().numpy()
    amid = points if len(points) else centres(reconstruction, reconstruction.viewmats)
    return Similarity(1.0, rotation, -np.einsum("ij,j->i", rotation, np.median(amid, axis=0)))


def up_of_cameras(reconstruction: Reconstruction) -> Float64[np.ndarray, "3"]:
    """The unit vector that is perpendicular to the rows of all photos and up in most of them.

    It minimises Σ (u · right_i)² + w Σ |u − up_i|². Cameras that look straight down with changing
    headings have no common up: it is then opposite to their viewing direction.
    """
    axes = _axes(reconstruction)
    right, up, forward = axes[:, 0], -axes[:, 1].mean(axis=0), axes[:, 2].mean(axis=0)
    if np.linalg.norm(forward) > 0.9 and np.linalg.norm(up) < 0.5:
        up = -forward
    normal = np.einsum("ni,nj->ij", right, right) / len(right) + _MEAN_WEIGHT * np.eye(3)
    solution = np.linalg.solve(normal, up)
    length = np.linalg.norm(solution)
    return solution / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])


def _axes(reconstruction: Reconstruction) -> Float64[np.ndarray, "n 3 3"]:
    """The cameras' axes (right, down, forward) as rows, in world coordinates."""
    return torch.stack(list(reconstruction.viewmats.values()))[:, :3, :3].numpy()
