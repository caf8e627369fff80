"""The lens of a thermal camera: diffraction, and defocus that depends on each pixel's depth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.fft import dctn, idctn
from scipy.special import j1

MOST_DISCS = 12
"""Sizes of the disc of defocus that are computed for one photo; others are interpolated."""


def diffraction_mtf(
    frequency: Float[np.ndarray, "*shape"], cutoff: float
) -> Float[np.ndarray, "*shape"]:
    """Modulation transfer of a perfect lens with a round aperture (the Airy pattern's).

    With s = ν / ν_c, ν_c = 1 / (λ N): MTF = 2/π (arccos s − s √(1 − s²)); 0 beyond the cutoff.
    """
    s = np.minimum(frequency / cutoff, 1.0)
    transfer: Float[np.ndarray, "*shape"] = 2.0 / np.pi * (np.arccos(s) - s * np.sqrt(1.0 - s * s))
    return transfer


def disc_mtf(frequency: Float[np.ndarray, "*shape"], radius: float) -> Float[np.ndarray, "*shape"]:
    """Optical transfer of an even disc, 2 J₁(2π r ν) / (2π r ν); negative where contrast turns
    over."""
    x = np.maximum(2.0 * np.pi * radius * frequency, 1e-9)
    transfer: Float[np.ndarray, "*shape"] = 2.0 * j1(x) / x
    return transfer


def through_lens(
    radiance: Float[np.ndarray, "h w"], radius: Float[np.ndarray, "h w"], cutoff: float
) -> Float[np.ndarray, "h w"]:
    """The image of a scene in which every point spreads over the disc of its own defocus, and this
    over the Airy pattern.

    The light of each place is the mean over the points whose discs reach it; the scene is mirrored
    at the image's edges.

    Args:
        radiance: of the samples of the scene.
        radius: of each sample's disc, in samples.
        cutoff: of the diffraction, cycles per sample; below 0.5, so that the samples suffice.
    """
    height, width = radiance.shape
    down, across = np.arange(height) / (2.0 * height), np.arange(width) / (2.0 * width)
    frequency = np.hypot(down[:, None], across[None, :])  # of the terms of the cosine transform
    airy = diffraction_mtf(frequency, cutoff)
    light, weight = np.zeros((height, width)), np.zeros((height, width))
    for level, share in _levels(radius):
        transfer = airy * disc_mtf(frequency, level)
        light += transfer * dctn(share * radiance)
        weight += transfer * dctn(share)
    image: Float[np.ndarray, "h w"] = idctn(light) / idctn(weight)
    return image


def _levels(
    radius: Float[np.ndarray, "h w"],
) -> list[tuple[float, Float[np.ndarray, "h w"]]]:
    """Some radii, at most a sample apart where there are enough, and the share that each has in
    every sample by linear interpolation."""
    least, most = float(radius.min()), float(radius.max())
    count = min(int(np.ceil(most - least)) + 1, MOST_DISCS)
    if count == 1:
        return [(least, np.ones(radius.shape))]
    place = (radius - least) / (most - least) * (count - 1)
    return [
        (float(level), np.maximum(1.0 - np.abs(place - number), 0.0))
        for number, level in enumerate(np.linspace(least, most, count))
    ]
