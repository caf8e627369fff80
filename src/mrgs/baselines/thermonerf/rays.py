"""Where a scene is, and the rays through its pixels."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from mrgs.scene import Camera, Scene

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


class Rays(NamedTuple):
    """Half lines from camera centres.

    Attributes:
        origins: in radii from the scene's centre, [R, 3].
        directions: unit vectors in world axes, [R, 3].
        cosines: of the angles to the optical axes, [R]: distance along the ray times this is
            z-depth.
    """

    origins: Float[Tensor, "r 3"]
    directions: Float[Tensor, "r 3"]
    cosines: Float[Tensor, " r"]


class CameraRays:
    """The rays of many cameras, whose pixels are numbered row by row, camera after camera.

    Args:
        cameras: at least one.
        frame: of the scene.
    """

    def __init__(self, cameras: list[Camera], frame: SceneFrame) -> None:
        self._widths = torch.tensor([camera.width for camera in cameras])
        counts = torch.tensor([camera.width * camera.height for camera in cameras])
        self._ends = counts.cumsum(dim=0)
        self._starts = self._ends - counts
        self._lenses = torch.stack([camera.K[[0, 1, 0, 1], [0, 1, 2, 2]] for camera in cameras])
        self._rotations = torch.stack([camera.viewmat[:3, :3] for camera in cameras])
        self._origins = frame.normalised(
            torch.stack([camera.position for camera in cameras])
        ).float()

    def __len__(self) -> int:
        return int(self._ends[-1])

    def through(self, pixels: Int64[Tensor, " r"]) -> Rays:
        """The rays through the centres of pixels, in float32."""
        image = torch.searchsorted(self._ends, pixels, right=True)
        place, width = pixels - self._starts[image], self._widths[image]
        fx, fy, cx, cy = self._lenses[image].unbind(dim=1)
        x = (place % width + 0.5 - cx) / fx
        y = (torch.div(place, width, rounding_mode="floor") + 0.5 - cy) / fy
        in_camera = torch.stack([x, y, torch.ones_like(x)], dim=1)
        lengths = in_camera.norm(dim=1)
        # d_world = Rᵀ d_camera; written out, because a library's product starts threads of its own.
        directions = (in_camera[:, :, None] * self._rotations[image]).sum(dim=1) / lengths[:, None]
        return Rays(self._origins[image], directions.float(), (1 / lengths).float())
