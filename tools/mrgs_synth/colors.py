"""Linear light and sRGB."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8


def to_srgb(linear: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Linear light -> 8-bit sRGB (IEC 61966-2-1); what lies outside [0, 1] is clipped."""
    value = linear.clip(0.0, 1.0)
    curve = np.where(
        value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 1e-9) ** (1 / 2.4) - 0.055
    )
    return np.round(255.0 * curve).astype(np.uint8)


def from_srgb(value: UInt8[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """8-bit sRGB -> linear light; the inverse of ``to_srgb``."""
    share = value / 255.0
    linear: Float[np.ndarray, "*shape"] = np.where(
        share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4
    )
    return linear


def luminance(color: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
    """Weighted sum of red, green and blue (ITU-R BT.709)."""
    return color @ np.array([0.2126, 0.7152, 0.0722])
