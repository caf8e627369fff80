"""All training photos in memory, and batches of rays drawn from them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from mrgs.baselines.thermonerf.rays import CameraRays, Rays, SceneFrame
from mrgs.errors import SceneError
from mrgs.scene import RGB, THERMAL, Modality, PosedImage, Scene

MODALITIES = (RGB, THERMAL)
"""Those that there are heads for."""


class Target(NamedTuple):
    """Photo values that the rays of a batch are compared with.

    Attributes:
        rows: the rays.
        values: colours [R, 3] or normalised temperatures [R, 1].
        valid: False where the pixel must be ignored, [R]; None if all count.
    """

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
            masks = [
                torch.ones(pixels.values.shape[:2], dtype=torch.bool)
                if pixels.valid is None
                else pixels.valid
                for pixels in loaded
            ]
            self.valid = torch.cat([mask.flatten() for mask in masks])

    def target(self, pixels: Int64[Tensor, " r"], start: int) -> Target:
        """The photo values of these pixels, for rays whose rows begin at ``start``."""
        valid = None if self.valid is None else self.valid[pixels]
        return Target(slice(start, start + len(pixels)), self.values[pixels], valid)


class PixelPool:
    """Draws rays at random over all training views.

    Where the images of each view share a camera, a ray is used for all modalities; else each
    modality has an equal share of the rays.

    Args:
        scene: its training photos are read and kept.
        frame: of the scene.

    Raises:
        SceneError: a photo cannot be read, or there is none in colour or thermal.
    """

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
