"""Where walls grow damp: the dew point of the air inside, and the temperature factor of a surface.

The pages with a 3D view compute the same in ``pictures/web/isotherm.js``.
"""

from __future__ import annotations

import math

MAGNUS_A, MAGNUS_B_C = 17.62, 243.12
"""Magnus' formula over water, -45 to 60 °C (WMO, Guide to Instruments and Methods of Observation):
e = 6.112 hPa exp(a t / (b + t))."""

LEAST_FACTOR = 0.7
"""The temperature factor below which a surface counts as at risk of mould (DIN 4108-2)."""


def dew_point_c(air_c: float, humidity: float) -> float:
    """The temperature at which the water of the air condenses, °C.

    Args:
        air_c: temperature of the air, °C.
        humidity: relative humidity, over 0 to 1.
    """
    return temperature_at_humidity_c(air_c, humidity, 1.0)


def temperature_at_humidity_c(air_c: float, humidity: float, at_surface: float) -> float:
    """The temperature of a surface at which the air on it has a relative humidity, °C.

    Args:
        air_c: temperature of the air in the room, °C.
        humidity: relative humidity of that air, over 0 to 1.
        at_surface: relative humidity at the surface; mould grows from 0.8 on.

    Raises:
        ValueError: a humidity is not over 0 to 1.
    """
    if not (0 < humidity <= 1 and 0 < at_surface <= 1):
        raise ValueError("a relative humidity is over 0 and at most 1")
    exponent = math.log(humidity / at_surface) + MAGNUS_A * air_c / (MAGNUS_B_C + air_c)
    return MAGNUS_B_C * exponent / (MAGNUS_A - exponent)


def temperature_factor(surface_c: float, inside_c: float, outside_c: float) -> float:
    """f_Rsi = (T_si - T_e) / (T_i - T_e) of a surface inside (ISO 13788).

    Raises:
        ValueError: it is not warmer inside than outside.
    """
    if not inside_c > outside_c:
        raise ValueError("the temperature factor needs a room that is warmer than outside")
    return (surface_c - outside_c) / (inside_c - outside_c)


def surface_at_factor_c(factor: float, inside_c: float, outside_c: float) -> float:
    """The temperature of a surface inside with a temperature factor, °C."""
    return outside_c + factor * (inside_c - outside_c)
