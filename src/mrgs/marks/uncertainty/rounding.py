"""What the rounding of a photo's values leaves in a mean over many of them.

Noise of half a step and more makes roundings average out; without noise, all pixels of an even
surface are rounded alike, in every photo (dither: L. Schuchman, IEEE Trans. Commun. 12(4), 1964).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32

OF_ONE_VALUE = 2 / 12**0.5
"""Half the width of the interval for 95 of 100 cases, in steps: whatever is within a step is
equally likely (GUM F.2.2.1)."""

BLOCK_PX = 8
_TERMS = 50


def of_mean(variance: float) -> float:
    """Half the width of the interval for 95 of 100 cases that rounding leaves in the mean of many
    values, in steps.

    The error of the mean of rounded values is a Fourier series in the true value; this is twice its
    root mean square.

    Args:
        variance: of normal noise before the rounding, in steps squared.
    """
    k = np.arange(1, _TERMS)
    squares = np.exp(-4 * np.pi**2 * k**2 * variance) / k**2
    return float(2 * np.sqrt(squares.sum() / 2) / np.pi)


def block_variances(values: Float32[np.ndarray, "h w"]) -> Float[np.ndarray, " b"]:
    """The variances of an image in squares of ``BLOCK_PX`` pixels; those with NaN are left out."""
    size, (height, width) = BLOCK_PX, values.shape
    rows, columns = height // size, width // size
    blocks = values[: rows * size, : columns * size].reshape(rows, size, columns, size)
    found = blocks.astype(np.float64).var(axis=(1, 3)).ravel()
    return found[np.isfinite(found)]
