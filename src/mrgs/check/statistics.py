"""Statistics of each view's pixels, from reading its images once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from torch import Tensor

from mrgs.data.thermal import LUMINANCE
from mrgs.errors import SceneError
from mrgs.prepare.page.previews import Preview, preview_of_pixels
from mrgs.scene import Pixels, PosedImage, TemperatureRange, View

_AT_END = 1e-3
"""Normalised; nearer than this to 0 or 1 (a quarter of an 8-bit step) a value lies at the end of
the scale."""


@dataclass(frozen=True, eq=False)
class ViewStatistics:
    """A view in small, and statistics of its pixels.

    Attributes:
        preview: the view at the size of the page.
        sharpness: of the RGB image, see ``sharpness``; None without one.
        cold_end: share of the thermal pixels at or below the scale's lower end; None without a
            thermal image.
        hot_end: share at or above its upper end.
        spread: between the 1 % and the 99 % quantile of the thermal image, normalised.
        failures: messages of images that cannot be read.
    """

    preview: Preview
    sharpness: float | None
    cold_end: float | None
    hot_end: float | None
    spread: float | None
    failures: tuple[str, ...]


def measure_view(
    view: View, status: str, temperature: TemperatureRange | None, width: int
) -> ViewStatistics:
    """Read the view's images; one that cannot be read is a failure, and else counts as missing."""
    failures: list[str] = []
    rgb, thermal = (_read(image, failures) for image in (view.rgb, view.thermal))
    ends = None if thermal is None else _ends(thermal)
    return ViewStatistics(
        preview=preview_of_pixels(view, status, temperature, width, rgb, thermal),
        sharpness=None if rgb is None else sharpness((rgb.values @ LUMINANCE).double().numpy()),
        cold_end=None if ends is None else ends[0],
        hot_end=None if ends is None else ends[1],
        spread=None if ends is None else ends[2],
        failures=tuple(failures),
    )


def sharpness(image: Float[np.ndarray, "h w"]) -> float:
    """How much of an image's contrast is in its finest details: 0 for a smooth image, about 1 for a
    crisp one.

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


def _read(image: PosedImage | None, failures: list[str]) -> Pixels | None:
    if image is None:
        return None
    try:
        return image.load()
    except SceneError as error:
        failures.append(str(error))
        return None


def _ends(pixels: Pixels) -> tuple[float, float, float]:
    """Shares of the usable pixels at the lower and upper end of the scale, and the spread of the
    values."""
    values: Float32[Tensor, "h w"] = pixels.values[..., 0]
    known = values.flatten() if pixels.valid is None else values[pixels.valid]
    if not known.numel():
        return 0.0, 0.0, 0.0
    low, high = np.quantile(known.numpy(), [0.01, 0.99])
    cold, hot = (
        (known <= _AT_END).float().mean().item(),
        (known >= 1 - _AT_END).float().mean().item(),
    )
    return cold, hot, float(high - low)
