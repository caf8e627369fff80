"""Structure that a photo and a thermal image share: positions and directions of edges.

Their contrasts differ, because bright surfaces may be cold. So gradients are split into channels by
their direction without sign (channel features of orientated gradients; Ye, Bruzzone, Shan, Bovolo
and Zhu, 2019).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import binary_erosion, gaussian_filter, uniform_filter

DIRECTIONS = 6
_GRADIENT_SIGMA_PX = 1.0
_SURROUNDINGS_PX = 41
_MARGIN_PX = 4


def structure(
    image: Float[np.ndarray, "h w"], blur_px: float, valid: Bool[np.ndarray, "h w"] | None = None
) -> Float32[np.ndarray, "c h w"]:
    """Strength of the edges in each of ``DIRECTIONS`` directions, less its mean in the
    surroundings.

    It does not change when the image is inverted, scaled or shifted in value.

    Args:
        image: any unit.
        blur_px: distance at which edges still correlate (σ of a Gaussian), pixels.
        valid: mask of usable pixels; the structure is 0 at and near the others.
    """
    if valid is not None:
        image = np.where(valid, image, np.median(image[valid]) if valid.any() else 0.0)
    down, right = np.gradient(gaussian_filter(image.astype(np.float32), _GRADIENT_SIGMA_PX))
    angles = (np.arange(DIRECTIONS) * np.pi / DIRECTIONS).astype(np.float32)
    channels = np.abs(np.cos(angles)[:, None, None] * right + np.sin(angles)[:, None, None] * down)
    if valid is not None:
        channels *= binary_erosion(valid, iterations=_MARGIN_PX, border_value=1)
    channels = gaussian_filter(channels, (0, blur_px, blur_px))
    channels = (np.roll(channels, 1, axis=0) + 2 * channels + np.roll(channels, -1, axis=0)) / 4
    strength = np.sqrt((channels**2).sum(axis=0))
    channels /= strength + np.median(strength) + 0.1 * strength.mean() + np.float32(1e-12)
    return channels - uniform_filter(channels, (1, _SURROUNDINGS_PX, _SURROUNDINGS_PX))
