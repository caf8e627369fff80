"""A view: the images of one moment, each with its own camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64
from torch import Tensor

from mrgs.scene.camera import Camera
from mrgs.scene.modality import Modality
from mrgs.scene.preview import preview_png
from mrgs.scene.radiometry import PhotoRecord


@dataclass(frozen=True, eq=False)
class Pixels:
    """A decoded image.

    Attributes:
        values: [H, W, C]; colours in [0, 1], normalised temperatures, or another modality's.
        valid: [H, W], False where a pixel must be ignored (masked, or not seen by the lens); None
            if all count.
    """

    values: Float32[Tensor, "h w c"]
    valid: Bool[Tensor, "h w"] | None = None


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image that is read when it is needed.

    Attributes:
        camera: the pinhole camera of the pixels that ``load`` returns.
        load: reads, undistorts and resizes the image; may raise SceneError. Reading twice gives the
            same bits.
        files: what ``load`` reads; empty where it reads no file.
        record: what the camera noted beside the photo; None if that is not known.
        load_at_least: as ``load``, with the same field of view in fewer pixels, but at least the
            given number across; None where that would not be faster.
    """

    camera: Camera
    load: Callable[[], Pixels]
    files: tuple[Path, ...] = ()
    record: PhotoRecord | None = None
    load_at_least: Callable[[int], Pixels] | None = None

    def look(self, width: int) -> Pixels:
        """The image where this many pixels across suffice: a large photo is read at a fraction of
        its size, in a fraction of the time. Others are as from ``load``. SceneError as for it."""
        return self.load() if self.load_at_least is None else self.load_at_least(width)


@dataclass(frozen=True, eq=False, repr=False)
class View:
    """One moment of a capture: an image of each modality that was captured, each with its own
    camera. ValueError without an image.

    Attributes:
        name: unique in the scene, usable as a file stem.
        images: by modality, RGB first where it is there; never empty.
    """

    name: str
    images: Mapping[Modality, PosedImage]

    def __post_init__(self) -> None:
        if not self.images:
            raise ValueError(f"view {self.name} has no image")

    def __repr__(self) -> str:
        sizes = ", ".join(f"{m} {i.camera.width}×{i.camera.height}" for m, i in self.images.items())
        return f"View({self.name!r}, {sizes})"

    def _repr_png_(self) -> bytes:
        """The photos side by side, for a notebook."""
        return preview_png([image.load().values for image in self.images.values()])

    @property
    def cameras(self) -> dict[Modality, Camera]:
        """The camera of each image."""
        return {modality: image.camera for modality, image in self.images.items()}

    @property
    def camera(self) -> Camera:
        """The camera of the first image: RGB where it is there."""
        return next(iter(self.images.values())).camera

    def shares_camera(self, one: Modality, other: Modality) -> bool:
        """Whether both images are there, from one camera."""
        return share_camera(self.cameras, one, other)


def share_camera(cameras: Mapping[Modality, Camera], one: Modality, other: Modality) -> bool:
    """Whether both modalities have a camera, the same one."""
    return one in cameras and other in cameras and cameras[one].coincides_with(cameras[other])


def evenly_spaced(count: int, most: int = 5) -> list[int]:
    """At most ``most`` indices of ``count`` views, evenly spread, with the first and the last."""
    return sorted({round(index) for index in np.linspace(0, count - 1, min(count, most))})


def moved_cameras(
    cameras: Mapping[Modality, Camera], motion: Float64[Tensor, "4 4"]
) -> dict[Modality, Camera]:
    """Cameras that see the world moved, in scene units."""
    return {
        modality: Camera(camera.K, camera.viewmat @ motion, camera.width, camera.height)
        for modality, camera in cameras.items()
    }


def moved_view(view: View, motion: Float64[Tensor, "4 4"]) -> View:
    """The view with the cameras that see the world moved."""
    cameras = moved_cameras(view.cameras, motion)
    images = {each: replace(view.images[each], camera=cameras[each]) for each in view.images}
    return replace(view, images=images)
