"""How noisy photos are, read off the photos themselves."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.scene import Pixels, PosedImage, evenly_spaced

PHOTOS = 16
"""Largest number of photos that are read, evenly spread."""

MEDIAN_OF_NORMAL = 0.6745
"""The median of the absolute value of a standard normal variable."""


def photo_noise(photos: Sequence[PosedImage], distance_px: int = 1) -> float:
    """Standard deviation of the noise of a pixel, in units of the photos' values; 0 without photos.

    A second difference along the rows and then along the columns removes whatever is locally a
    plane, and has 6 times the standard deviation of independent noise (J. Immerkær, Fast Noise
    Variance Estimation, 1996, where it is between neighbours). Its median over all pixels
    hardly sees edges, which are few. Values in steps, of 8 bits for instance, count as noise of
    about a quarter of a step or more.

    Args:
        photos: of one modality.
        distance_px: between the pixels of a difference. Cameras with few detector pixels write more
            by interpolation, and the noise of one detector pixel is that of several pixels of the
            photo, which neighbours do not tell.
    """
    chosen = [photos[index].load() for index in evenly_spaced(len(photos), PHOTOS)]
    responses = [_second_differences(photo, distance_px).abs() for photo in chosen]
    found = (
        torch.cat([each[each.isfinite()] for each in responses]) if responses else torch.empty(0)
    )
    return found.median().item() / MEDIAN_OF_NORMAL / 6 if len(found) > 0 else 0.0


def _second_differences(photo: Pixels, distance_px: int) -> Float[Tensor, " n"]:
    """Differences at all pixels whose neighbours at that distance are in the photo; NaN where one
    of these is not valid."""
    values = photo.values
    if photo.valid is not None:
        values = torch.where(photo.valid[:, :, None], values, torch.nan)
    for axis in (0, 1):
        steps = max(values.shape[axis] - 2 * distance_px, 0)
        before, here, behind = (
            values.narrow(axis, k * distance_px if steps else 0, steps) for k in range(3)
        )
        values = before - 2 * here + behind
    return values.flatten()
