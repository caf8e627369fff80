"""How far a scene reaches, and where the background begins that photos show behind it: the sky."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from mrgs.scene.arrays import constant
from mrgs.scene.camera import Camera

FARTHEST_SHARE = 0.99
"""A few start points may lie anywhere: those beyond this share of them do not count."""

TIMES_AS_FAR = 8.0
"""The background is put so many times as far away as the scene reaches: it must not shift against
the scene as the camera moves from photo to photo."""


class Reach(NamedTuple):
    """A ball that holds the cameras and nearly all start points.

    Attributes:
        centre: of the cameras, world coordinates, [3].
        radius: scene units.
    """

    centre: Float64[Tensor, "3"]
    radius: float

    @property
    def background_distance(self) -> float:
        """Distance of the background from the centre, scene units."""
        return TIMES_AS_FAR * self.radius

    def is_background(self, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Whether points of the world, [..., 3], lie nearer to the background than to the scene;
        NaN does not."""
        centre = constant(tuple(self.centre.tolist()), points)
        return (points - centre).norm(dim=-1) > (self.background_distance + self.radius) / 2

    def without_background(
        self, camera: Camera, depth: Float[Tensor, "h w"]
    ) -> Float[Tensor, "h w"]:
        """A camera's z-depths in scene units, infinite where they are those of the background."""
        return torch.where(self.is_background(camera.unproject_image(depth)), torch.inf, depth)


def reach(points: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> Reach:
    """How far a scene reaches from the middle of its cameras.

    Args:
        points: start points in world coordinates, at least one.
        cameras: of the training photos, at least one.
    """
    places = torch.stack([camera.position for camera in cameras])
    centre = places.mean(dim=0)
    distances = (points.double() - centre).norm(dim=1)
    farthest = distances.kthvalue(math.ceil(FARTHEST_SHARE * len(distances))).values
    return Reach(centre, torch.maximum(farthest, (places - centre).norm(dim=1).max()).item())
