"""Where a scene lies: the cube that the grids cover best, and the range in which rays meet
something."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.scene import Scene

NEAR_SHARE = 0.5
NEAR_QUANTILE = 0.01
FAR_FACTOR = 100.0
"""Rays are followed from half the distance at which the nearest hundredth of the start points lies
to this many times their median distance: beyond it nothing is distinguishable from infinity."""

MOST_POINTS = 5_000
"""Start points that are looked at from every camera."""


class SceneFrame(NamedTuple):
    """Centre and size of a scene, and the range in which rays are sampled.

    Attributes:
        centre: median of the start points, world coordinates, [3].
        radius: half the side of the cube that is not contracted, scene units: median distance of
            the start points from the centre along their largest axis.
        near: distance along a ray at which sampling starts, in radii.
        middle: median distance from the cameras to the start points in front of them, in radii.
        far: distance at which sampling ends, in radii.
    """

    centre: Float[Tensor, "3"]
    radius: float
    near: float
    middle: float
    far: float

    def normalised(self, positions: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """World coordinates in radii from the centre."""
        return (positions - self.centre.to(positions)) / self.radius


def frame_of(scene: Scene) -> SceneFrame:
    """The frame that a scene's start points and training cameras give."""
    points = scene.points.positions.double()
    centre = points.median(dim=0).values
    smallest = 1e-6 * scene.extent
    radius = max((points - centre).abs().amax(dim=1).median().item(), smallest)
    distances = _distances(points[:: max(1, len(points) // MOST_POINTS)], scene)
    near = NEAR_SHARE * distances.quantile(NEAR_QUANTILE).item()
    middle = max(distances.median().item(), smallest)
    return SceneFrame(centre, radius, near / radius, middle / radius, FAR_FACTOR * middle / radius)


def _distances(points: Float[Tensor, "n 3"], scene: Scene) -> Float[Tensor, " m"]:
    """Distances from each training camera to the points in its image; to all points if no camera
    sees any."""
    seen = []
    for camera in (camera for view in scene.train for camera in view.cameras.values()):
        pixels, _ = camera.project(points)
        seen.append((points[camera.contains(pixels)] - camera.position).norm(dim=1))
    distances = torch.cat(seen)
    if len(distances) == 0:
        distances = (points - scene.train[0].camera.position).norm(dim=1)
    return distances[:: max(1, len(distances) // 1_000_000)]


def contract(positions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """All of space into [0, 1]³: the cube [-1, 1]³ fills the inner half, and infinity is the
    border.

    Eq. 10 of mip-NeRF 360 (Barron et al. 2022) with the maximum norm: x for |x| ≤ 1, else (2 −
    1/|x|) x/|x|.
    """
    size = positions.abs().amax(dim=1, keepdim=True).clamp(min=1)
    return positions * ((2 - 1 / size) / size) * 0.25 + 0.5
