"""Radiance of black bodies in the band of thermal cameras, and the temperature behind a radiance.

Planck's law, L(λ, T) = 2 h c² λ⁻⁵ / (exp(h c / (λ k T)) − 1), integrated over 7.5 to 13 µm.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float

KELVIN = 273.15
BAND_UM = (7.5, 13.0)
COLDEST_C, HOTTEST_C, STEP_C = -150.0, 1500.0, 0.1
"""Of the table between whose entries both functions interpolate linearly; each is therefore the
exact inverse of the other."""

RADIATION_1 = 2.0 * 6.62607015e-34 * 299792458.0**2
"""2 h c², W m²/sr."""
RADIATION_2 = 6.62607015e-34 * 299792458.0 / 1.380649e-23
"""h c / k, m K."""


def band_radiance(celsius: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Radiance of black bodies in the band, W/(m² sr)."""
    return np.interp(celsius, *_table())


def temperature(radiance: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Temperature of the black bodies with these radiances in the band, °C."""
    return np.interp(radiance, *reversed(_table()))


def radiance_per_degree(celsius: float) -> float:
    """Change of the band's radiance per degree, W/(m² sr K)."""
    colder, warmer = band_radiance(np.array([celsius - 0.5, celsius + 0.5]))
    return float(warmer - colder)


@cache
def _table() -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Temperatures, °C, and their radiances."""
    celsius = np.linspace(COLDEST_C, HOTTEST_C, round((HOTTEST_C - COLDEST_C) / STEP_C) + 1)
    nodes, weights = np.polynomial.legendre.leggauss(32)
    shortest, longest = (1e-6 * end for end in BAND_UM)
    half = (longest - shortest) / 2.0
    wavelength = shortest + half * (nodes + 1.0)
    exponent = RADIATION_2 / (wavelength * (celsius[:, None] + KELVIN))
    return celsius, half * (RADIATION_1 * wavelength**-5 / np.expm1(exponent)) @ weights
