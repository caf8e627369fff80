"""Scenes in so large a unit of length that what photos show lies nearer than the near plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from mrgs.rasterizer.contract import NEAR_PLANE
from mrgs.scene import Camera
from mrgs.scene.view import evenly_spaced

FEW = 0.01
"""If a smaller share of what the cameras see lies nearer, a training hardly suffers:
docs/decisions."""

CAMERAS, POINTS = 200, 2_000
"""How many of each are looked at."""

USUAL = 100.0
"""Where half of what the cameras see is so many times as far away as the near plane, the unit is
small enough: what lies before the plane are stray points."""


class TooNear(NamedTuple):
    """What lies nearer than the near plane.

    Attributes:
        share: of what the cameras see.
        factor: a power of ten by which the scene should be multiplied.
    """

    share: float
    factor: int

    @property
    def text(self) -> str:
        """What is wrong, in a sentence."""
        return (
            f"{self.share:.0%} of what the cameras see lies nearer than {NEAR_PLANE:g} units, "
            f"where nothing is rendered."
        )

    @property
    def remedy(self) -> str:
        """What to do, in a sentence."""
        return f"Scale the poses and the points together, such as by {self.factor:,}."


def too_near(cameras: Sequence[Camera], points: Float[Tensor, "n 3"]) -> TooNear | None:
    """How much of what the cameras see is left out for being too near; None if it is little.

    Args:
        cameras: of the photos.
        points: start points in world coordinates.
    """
    chosen = points[evenly_spaced(len(points), POINTS)].double()
    looking = [cameras[place] for place in evenly_spaced(len(cameras), CAMERAS)]
    depths = torch.cat([_seen_depths(camera, chosen) for camera in looking])
    if not len(depths):
        return None
    share = (depths < NEAR_PLANE).double().mean().item()
    missing = math.log10(USUAL * NEAR_PLANE / depths.median().item())
    return TooNear(share, 10 ** math.ceil(missing)) if share > FEW and missing > 0 else None


def _seen_depths(camera: Camera, points: Float64[Tensor, "n 3"]) -> Float64[Tensor, " k"]:
    """The z-depths of the points that a camera sees, in scene units, however small these are."""
    x, y, depth = (points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).unbind(dim=1)
    pixels = torch.stack([x, y], dim=1) / depth[:, None] * camera.K.diagonal()[:2]
    return depth[(depth > 0) & camera.contains(pixels + camera.K[:2, 2])]
