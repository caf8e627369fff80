"""A small thermal camera: what it makes of exact temperatures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt
from scipy.ndimage import gaussian_filter

from mrgs.scene import TemperatureRange
from mrgs_synth.planck import band_radiance, radiance_per_degree, temperature

# Variance in px² that averaging 2×2 pixels (0.25) and doubling the image by linear interpolation
# (0.75) add.
_DETECTOR_VARIANCE_PX2 = 1.0

NETD_AT_C = 30.0
"""Where makers state the noise: it is radiance, and so more °C where a surface is colder."""


@dataclass(frozen=True)
class ThermalSensor:
    """A detector with half as many pixels as the image that the camera writes, as in phone cameras.

    Attributes:
        point_spread_px: standard deviation, in pixels of the written image, of everything that
            spreads a point: lens, detector pixel and interpolation; at least 1, which the detector
            alone has.
        netd_c: standard deviation of the noise of each detector pixel (NETD), °C at ``NETD_AT_C``.
        column_noise_c: standard deviation of the offsets of the detector's columns, the same in
            every frame, °C at ``NETD_AT_C``.
    """

    point_spread_px: float = 1.2
    netd_c: float = 0.12
    column_noise_c: float = 0.04

    def photograph(
        self, exact_c: Float[np.ndarray, "h w"], frame: int, seed: int
    ) -> Float[np.ndarray, "h w"]:
        """The temperatures that the camera reports, °C.

        Args:
            exact_c: exact temperatures of the pixels, °C; height and width are even.
            frame: number of the frame; the noise changes with it, the column offsets do not.
            seed: which camera.
        """
        height, width = exact_c.shape
        lens_px = np.sqrt(self.point_spread_px**2 - _DETECTOR_VARIANCE_PX2)
        blurred = gaussian_filter(band_radiance(exact_c), lens_px, mode="reflect")
        detector = blurred.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
        columns = np.random.default_rng([seed, 1]).normal(0.0, self.column_noise_c, width // 2)
        noise = np.random.default_rng([seed, 2, frame]).normal(0.0, self.netd_c, detector.shape)
        celsius = temperature(detector + radiance_per_degree(NETD_AT_C) * (columns + noise))
        return _doubled(_doubled(celsius).T).T


def _doubled(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h2 w"]:
    """Twice as many rows by linear interpolation between the centres of the rows."""
    padded = np.pad(image, ((1, 1), (0, 0)), mode="edge")
    rows = np.stack([0.25 * padded[:-2] + 0.75 * image, 0.75 * image + 0.25 * padded[2:]], axis=1)
    return rows.reshape(-1, image.shape[1])


def quantise(
    celsius: Float[np.ndarray, "h w"],
    temperature: TemperatureRange,
    bits: Literal[8, 16] = 8,
) -> UInt[np.ndarray, "h w"]:
    """°C -> grey of 8 or 16 bits over the range; what lies outside is clipped."""
    value = (celsius - temperature.min_c) / temperature.span_c
    white = 2**bits - 1
    return np.round(white * value.clip(0.0, 1.0)).astype(np.uint8 if bits == 8 else np.uint16)


def rounded_range(coldest_c: float, hottest_c: float) -> TemperatureRange:
    """The range in whole °C that holds both temperatures and half a degree of noise beyond them."""
    return TemperatureRange(float(np.floor(coldest_c - 0.5)), float(np.ceil(hottest_c + 0.5)))
