"""The captured view that shows most."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.scene.camera import Camera

NEARLY_AS_MUCH = 0.02
"""Views that show less of the points by at most this share are as good as the best one."""

MOST_POINTS = 5000


def best_view(cameras: Sequence[Camera], points: Float[Tensor, "n 3"]) -> int:
    """Index of the camera that has most of a scene in its image; of several that have as much, the
    one that has the middle of the scene nearest to its axis.

    Args:
        cameras: at least one.
        points: of the scene's surfaces, world coordinates, at least one.
    """
    points = points[:: max(1, len(points) // MOST_POINTS)].double()
    middle = points.median(dim=0).values
    shares, turns = [], []
    for camera in cameras:
        pixels, _ = camera.project(points)
        shares.append(camera.contains(pixels).double().mean())
        towards = torch.nn.functional.normalize(middle - camera.position, dim=0)
        turns.append(towards @ camera.forward)
    share, turn = torch.stack(shares), torch.stack(turns)
    return int(torch.where(share >= share.max() - NEARLY_AS_MUCH, turn, -2.0).argmax())
