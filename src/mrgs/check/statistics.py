"""Statistics of each view's pixels, from reading its images once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mrgs.data.images import LUMINANCE
from mrgs.errors import SceneError
from mrgs.prepare.page.previews import Preview, preview_of_pixels
from mrgs.scene import Modality, Pixels, PosedImage, TemperatureRange, View

LOOKED_AT_PX = 1600
"""A large photo may be read at a fraction of its size that is at least so wide: blur that does not
show there blurs hardly any model."""

_AT_END = 1e-3
"""Normalised; nearer than this to 0 or 1 (a quarter of an 8-bit step) a value lies at the end of
the scale."""


@dataclass(frozen=True)
class ImageStatistics:
    """Statistics of an image's pixels; of a colour image, of its luminance.

    Attributes:
        sharpness: see ``sharpness``.
        low_end: share of the usable pixels at or below the scale's lower end.
        high_end: share at or above its upper end.
        spread: between the 1 % and the 99 % quantile, normalised.
    """

    sharpness: float
    low_end: float
    high_end: float
    spread: float


@dataclass(frozen=True, eq=False)
class ViewStatistics:
    """The preview of a view, and statistics of its pixels.

    Attributes:
        preview: the view at the size of the page.
        images: by modality; images that are missing or cannot be read are left out.
        failures: messages of images that cannot be read.
    """

    preview: Preview
    images: Mapping[Modality, ImageStatistics]
    failures: tuple[str, ...]


def measure_view(
    view: View, status: str, temperature: TemperatureRange | None, width: int
) -> ViewStatistics:
    """Read the view's images; one that cannot be read is a failure, and else counts as missing."""
    pixels: dict[Modality, Pixels] = {}
    failures: list[str] = []
    for modality, image in view.images.items():
        found = _load(image)
        if isinstance(found, Pixels):
            pixels[modality] = found
        else:
            failures.append(found)
    return ViewStatistics(
        preview_of_pixels(view, status, temperature, width, pixels),
        {modality: _measure(found) for modality, found in pixels.items()},
        tuple(failures),
    )


def _load(image: PosedImage) -> Pixels | str:
    """The image, or why it cannot be read."""
    try:
        return image.look(LOOKED_AT_PX)
    except SceneError as error:
        return str(error)


def _measure(pixels: Pixels) -> ImageStatistics:
    values = pixels.values
    luminance = values @ LUMINANCE if values.shape[-1] == 3 else values.mean(dim=-1)
    sharp = sharpness(luminance.double().numpy())
    known = luminance.flatten() if pixels.valid is None else luminance[pixels.valid]
    if not known.numel():
        return ImageStatistics(sharp, 0.0, 0.0, 0.0)
    low, high = np.quantile(known.numpy(), [0.01, 0.99])
    return ImageStatistics(
        sharp,
        low_end=(known <= _AT_END).float().mean().item(),
        high_end=(known >= 1 - _AT_END).float().mean().item(),
        spread=float(high - low),
    )


def sharpness(image: Float[np.ndarray, "h w"]) -> float:
    """Share of an image's contrast in its finest details: 0 for a smooth image, about 1 for a crisp
    one.

    The mean squared difference between neighbours over that at half the resolution, in the
    direction where it is smaller: motion blurs in one direction. It hardly depends on the content.
    """
    height, width = (size // 2 * 2 for size in image.shape)
    fine = image[:height, :width]
    coarse = fine.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
    ratios = []
    for axis in (0, 1):
        below = np.square(np.diff(coarse, axis=axis)).mean() if min(coarse.shape) > 1 else 0.0
        ratios.append(
            np.square(np.diff(fine, axis=axis)).mean() / below - 0.25 if below > 1e-12 else 0.0
        )
    return float(max(min(ratios), 0.0))
