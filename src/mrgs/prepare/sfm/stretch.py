"""Contrast of thermal images for feature detection: one range of temperatures for the whole set,
then local histogram equalisation.

Features are detected at edges. In a thermal image a few hot or cold things take most of the range,
and the edges of all others are a few shades deep.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8
from scipy.ndimage import gaussian_filter

from mrgs.data.images import decode
from mrgs.errors import SceneError

SPAN_PERCENTILES = (0.5, 99.5)
TILES = 8
"""Along the longer side."""

BINS = 1024
CLIP = 10.0
"""Limit of a histogram over its mean: a higher one amplifies the noise of flat surfaces."""

_NOISE_SIGMA_PX = 0.7
_SAMPLES = 4096


def span_of(files: Iterable[Path]) -> tuple[float, float]:
    """The values between which nearly all pixels of a set lie.

    Raises:
        SceneError: an image cannot be read, or all pixels are alike.
    """
    samples = []
    for file in files:
        decoded = decode(file)
        values = decoded.values.mean(dim=-1)
        values = values.ravel() if decoded.valid is None else values[decoded.valid]
        samples.append(values[:: max(len(values) // _SAMPLES, 1)].numpy())
    low, high = np.percentile(np.concatenate(samples), SPAN_PERCENTILES)
    if not high > low:
        raise SceneError(
            "the thermal images show the same value everywhere; check that they are the right files"
        )
    return float(low), float(high)


def stretched(file: Path, span: tuple[float, float]) -> UInt8[np.ndarray, "h w"]:
    """The image in grey, with stretched contrast.

    Raises:
        SceneError: it cannot be read.
    """
    decoded = decode(file)
    values = decoded.values.mean(dim=-1).numpy()
    if decoded.valid is not None:
        values[~decoded.valid.numpy()] = span[0]
    shares = np.clip((values - span[0]) / (span[1] - span[0]), 0, 1)
    return np.rint(255 * local_contrast(gaussian_filter(shares, _NOISE_SIGMA_PX))).astype(np.uint8)


def local_contrast(shares: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Contrast-limited adaptive histogram equalisation (Zuiderveld, 1994) of values from 0 to 1.

    Each pixel's value is replaced by its rank in the tiles around it, linear between their centres.
    """
    height, width = shares.shape
    side = max(height, width) / TILES
    rows, columns = max(round(height / side), 1), max(round(width / side), 1)
    bins = np.minimum((shares * BINS).astype(np.int64), BINS - 1)
    ranks = np.stack(
        [
            np.stack([_ranks(tile) for tile in np.array_split(band, columns, axis=1)])
            for band in np.array_split(bins, rows, axis=0)
        ]
    )
    above, below, down = _neighbours(height, rows)
    left, right, across = _neighbours(width, columns)
    down, across = down[:, None], across[None]
    upper = (1 - across) * ranks[above[:, None], left, bins] + across * ranks[
        above[:, None], right, bins
    ]
    lower = (1 - across) * ranks[below[:, None], left, bins] + across * ranks[
        below[:, None], right, bins
    ]
    return ((1 - down) * upper + down * lower).astype(np.float32)


def _ranks(tile: np.ndarray) -> Float32[np.ndarray, " bins"]:
    """For each value the share of the tile's pixels below it, with the histogram's peaks
    clipped and redistributed evenly."""
    histogram = np.bincount(tile.ravel(), minlength=BINS).astype(np.float64)
    limit = CLIP * tile.size / BINS
    excess = np.maximum(histogram - limit, 0).sum()
    return (np.cumsum(np.minimum(histogram, limit) + excess / BINS) / max(tile.size, 1)).astype(
        np.float32
    )


def _neighbours(size: int, tiles: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each pixel along a side the tiles before and after it, and its share of the way between
    their centres."""
    place = (np.arange(size) + 0.5) * tiles / size - 0.5
    before = np.clip(np.floor(place), 0, tiles - 1).astype(np.int64)
    return before, np.minimum(before + 1, tiles - 1), np.clip(place - before, 0, 1)
