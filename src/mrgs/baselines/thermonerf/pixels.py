"""All training photos in memory, and batches of rays drawn from them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from mrgs.baselines.thermonerf.frame import Frame
from mrgs.baselines.thermonerf.rays import CameraRays, Rays
from mrgs.scene import PosedImage, Scene


class Target(NamedTuple):
    """What rays of a batch should see.

    Attributes:
        rows: the rays.
        values: colours [R, 3] or normalised temperatures [R, 1].
        valid: False where the pixel must be ignored, [R]; None if all count.
    """

    rows: slice
    values: Float[Tensor, "r c"]
    valid: Bool[Tensor, " r"] | None


class Batch(NamedTuple):
    """Rays and what they should see; None for a modality that the scene lacks."""

    rays: Rays
    rgb: Target | None
    thermal: Target | None


class _Photos:
    """The pixels of one modality, in the order of ``CameraRays``."""

    def __init__(self, images: list[PosedImage]) -> None:
        loaded = [image.load() for image in images]
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
        """What the rays through these pixels should see; their rows begin at ``start``."""
        valid = None if self.valid is None else self.valid[pixels]
        return Target(slice(start, start + len(pixels)), self.values[pixels], valid)


class PixelPool:
    """Draws rays at random over all training views.

    Where each view's two images share a camera, a ray serves both modalities; else half of the rays
    are RGB's.

    Args:
        scene: its training photos are read and kept.
        frame: of the scene.

    Raises:
        SceneError: a photo cannot be read.
    """

    def __init__(self, scene: Scene, frame: Frame) -> None:
        rgb = [view.rgb for view in scene.train if view.rgb is not None]
        thermal = [view.thermal for view in scene.train if view.thermal is not None]
        self._rgb = _Photos(rgb) if rgb else None
        self._thermal = _Photos(thermal) if thermal else None
        self._rgb_rays = CameraRays([image.camera for image in rgb], frame) if rgb else None
        self._thermal_rays = (
            CameraRays([image.camera for image in thermal], frame) if thermal else None
        )
        self._is_shared = all(view.shares_camera for view in scene.train)

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        """A batch of ``count`` rays (one more if it must be halved and is odd)."""
        if self._is_shared:
            assert self._rgb is not None
            assert self._thermal is not None
            assert self._rgb_rays is not None
            pixels = torch.randint(len(self._rgb_rays), (count,), generator=generator)
            return Batch(
                self._rgb_rays.through(pixels),
                self._rgb.target(pixels, 0),
                self._thermal.target(pixels, 0),
            )
        parts: list[Rays] = []
        targets: list[Target | None] = []
        each = count if self._rgb is None or self._thermal is None else -(-count // 2)
        for photos, rays in ((self._rgb, self._rgb_rays), (self._thermal, self._thermal_rays)):
            if photos is None or rays is None:
                targets.append(None)
                continue
            pixels = torch.randint(len(rays), (each,), generator=generator)
            targets.append(photos.target(pixels, each * len(parts)))
            parts.append(rays.through(pixels))
        return Batch(Rays(*(torch.cat(tensors) for tensors in zip(*parts, strict=True))), *targets)
