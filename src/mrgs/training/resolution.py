"""Photos and their cameras on a coarser grid. A training begins with these, because a step on them
takes less time."""

from __future__ import annotations

from collections.abc import Mapping

from mrgs.data.undistort import resize
from mrgs.scene import Camera, Modality, Pixels

SMALLEST_PX = 160
"""No side of an image is made shorter than this: what is smaller loses more than it saves."""


def coarser(
    cameras: Mapping[Modality, Camera], photos: Mapping[Modality, Pixels], pixel_size: int
) -> tuple[Mapping[Modality, Camera], Mapping[Modality, Pixels]]:
    """A view's cameras and photos with pixels of so many of the photos' in each direction.

    What a coarse pixel averages is as for ``--resolution``; it counts where all of that does.
    Images that would become too small get smaller pixels.

    Args:
        cameras: of the view, by modality.
        photos: of the same modalities.
        pixel_size: a power of two; 1 for the photos as they are.
    """
    if pixel_size == 1:
        return cameras, photos
    resized = {
        modality: _coarser_camera(camera, pixel_size) for modality, camera in cameras.items()
    }
    return resized, {
        modality: _resized(pixels, resized[modality]) for modality, pixels in photos.items()
    }


def pixel_sizes(
    cameras: Mapping[Modality, Camera], coarse: Mapping[Modality, Camera]
) -> dict[Modality, float]:
    """How many pixels of the cameras a pixel of the coarser ones spans, by modality."""
    return {modality: camera.width / coarse[modality].width for modality, camera in cameras.items()}


def coarse_size(width: int, height: int, pixel_size: int) -> tuple[int, int]:
    """The pixels of an image whose own become so large, as far as it does not become too small."""
    while pixel_size > 1 and min(width, height) < SMALLEST_PX * pixel_size:
        pixel_size //= 2
    return width // pixel_size, height // pixel_size


def _coarser_camera(camera: Camera, pixel_size: int) -> Camera:
    size = coarse_size(camera.width, camera.height, pixel_size)
    return camera if size == (camera.width, camera.height) else camera.resized(*size)


def _resized(pixels: Pixels, camera: Camera) -> Pixels:
    """The pixels on the grid of a camera."""
    return Pixels(*resize(pixels.values, pixels.valid, camera.width, camera.height))
