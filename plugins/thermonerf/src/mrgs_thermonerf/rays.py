"""Where a scene is, the rays through its pixels, and batches of them with the photos' values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from mrgs.errors import SceneError
from mrgs.scene import RGB, THERMAL, Camera, Modality, PosedImage, Scene

NEAR_SHARE = 0.5
NEAR_QUANTILE = 0.01
FAR_FACTOR = 100.0
"""Rays are followed from half the distance at which the nearest hundredth of the start points lies
to this many times their median distance: beyond it nothing is distinguishable from infinity."""

MOST_POINTS = 5_000
"""Number of start points whose distances from the cameras are measured."""


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
    # From each training camera to the points in its image; to all points if none sees any.
    points, seen = points[:: max(1, len(points) // MOST_POINTS)], []
    for camera in (camera for view in scene.train for camera in view.cameras.values()):
        pixels, _ = camera.project(points)
        seen.append((points[camera.contains(pixels)] - camera.position).norm(dim=1))
    distances = torch.cat(seen)
    if len(distances) == 0:
        distances = (points - scene.train[0].camera.position).norm(dim=1)
    distances = distances[:: max(1, len(distances) // 1_000_000)]
    near = NEAR_SHARE * distances.quantile(NEAR_QUANTILE).item()
    middle = max(distances.median().item(), smallest)
    return SceneFrame(centre, radius, near / radius, middle / radius, FAR_FACTOR * middle / radius)


def contract(positions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """All of space into [0, 1]³: the cube [-1, 1]³ fills the inner half, and infinity is the
    border.

    Eq. 10 of mip-NeRF 360 (Barron et al. 2022) with the maximum norm: x for |x| ≤ 1, else (2 −
    1/|x|) x/|x|.
    """
    size = positions.abs().amax(dim=1, keepdim=True).clamp(min=1)
    return positions * ((2 - 1 / size) / size) * 0.25 + 0.5


class Rays(NamedTuple):
    """Half lines from camera centres: their origins, in radii from the scene's centre; unit vectors
    in world axes; and the cosines of the angles to the optical axes: distance along the ray times
    this is z-depth."""

    origins: Float[Tensor, "r 3"]
    directions: Float[Tensor, "r 3"]
    cosines: Float[Tensor, " r"]


class CameraRays:
    """The rays of cameras, whose pixels are numbered row by row, camera after camera."""

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


MODALITIES = (RGB, THERMAL)
"""Those that there are heads for."""


class Target(NamedTuple):
    """Colours or normalised temperatures that these rows of a batch's rays are compared with, and
    which of them count; all if None."""

    rows: slice
    values: Float[Tensor, "r c"]
    valid: Bool[Tensor, " r"] | None


class Batch(NamedTuple):
    """Rays and what they should see, of the modalities that the scene has."""

    rays: Rays
    targets: Mapping[Modality, Target]


class _Photos:
    """The pixels of one modality and their rays, in the order of ``CameraRays``."""

    def __init__(self, images: list[PosedImage], frame: SceneFrame) -> None:
        loaded = [image.load() for image in images]
        self.rays = CameraRays([image.camera for image in images], frame)
        self.values = torch.cat([pixels.values.flatten(0, 1) for pixels in loaded])
        self.valid = None
        if any(pixels.valid is not None for pixels in loaded):
            everywhere = [torch.ones(each.values.shape[:2], dtype=torch.bool) for each in loaded]
            masks = (
                every if each.valid is None else each.valid
                for each, every in zip(loaded, everywhere, strict=True)
            )
            self.valid = torch.cat([mask.flatten() for mask in masks])

    def target(self, pixels: Int64[Tensor, " r"], start: int) -> Target:
        """The photo values of these pixels, for rays whose rows begin at ``start``."""
        valid = None if self.valid is None else self.valid[pixels]
        return Target(slice(start, start + len(pixels)), self.values[pixels], valid)


class PixelPool:
    """Draws rays at random over all training views, whose photos are read and kept. A ray is used
    for all modalities where they share a camera; else each has an equal share of the rays.
    SceneError if a photo cannot be read, or there is none in colour or thermal."""

    def __init__(self, scene: Scene, frame: SceneFrame) -> None:
        if not set(MODALITIES) & set(scene.modalities):
            raise SceneError(
                f"{scene.name} has neither RGB nor thermal photos, and thermonerf renders no others"
            )
        views = [view.images for view in scene.train]
        self._photos = {
            modality: _Photos([images[modality] for images in views if modality in images], frame)
            for modality in MODALITIES
            if modality in scene.modalities
        }
        self._is_shared = all(view.shares_camera(*MODALITIES) for view in scene.train)

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        """A batch of ``count`` rays (a few more if they cannot be shared out evenly)."""
        targets: dict[Modality, Target] = {}
        if self._is_shared:
            rays = next(iter(self._photos.values())).rays
            pixels = torch.randint(len(rays), (count,), generator=generator)
            for modality, photos in self._photos.items():
                targets[modality] = photos.target(pixels, 0)
            return Batch(rays.through(pixels), targets)
        parts: list[Rays] = []
        each = -(-count // len(self._photos))
        for modality, photos in self._photos.items():
            pixels = torch.randint(len(photos.rays), (each,), generator=generator)
            targets[modality] = photos.target(pixels, each * len(parts))
            parts.append(photos.rays.through(pixels))
        return Batch(Rays(*(torch.cat(tensors) for tensors in zip(*parts, strict=True))), targets)
