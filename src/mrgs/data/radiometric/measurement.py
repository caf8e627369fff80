"""From the signal of an infrared detector to the temperature of what it looks at.

Planck's law in the form of a camera's calibration, and the measurement formula with its reflected,
atmospheric and window terms are in the user manuals of FLIR's cameras, chapter "The measurement
formula"; the transmission of the air is FLIR's, with the constants that its cameras store. Both are
discussed in W. Minkina and S. Dudzik, *Infrared
Thermography: Errors and Uncertainties*, Wiley 2009.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt16

from mrgs.scene.temperature import ZERO_CELSIUS_K

COLDEST_C, HOTTEST_C = -200.0, 3500.0
"""Range of thermal cameras, °C; pixels outside of it are masked."""

MAX_TRANSMISSION = 1.05
"""The empirical formula may exceed 1 by a little in damp, warm air."""


@dataclass(frozen=True)
class ObjectParameters:
    """Parameters of the measurement, as set in the camera.

    Attributes:
        emissivity: of the object's surface, over 0 to 1.
        distance_m: from the camera to the object, m.
        reflected_c: reflected apparent temperature: what the surroundings, mirrored in the surface,
            look like, °C.
        atmospheric_c: temperature of the air between the camera and the object, °C.
        humidity: relative humidity of that air, 0 to 1.
        window_c: temperature of an infrared window or an external lens at the camera, °C.
        window_transmission: of that window, over 0 to 1; 1 without a window.
    """

    emissivity: float
    distance_m: float
    reflected_c: float
    atmospheric_c: float
    humidity: float
    window_c: float = 20.0
    window_transmission: float = 1.0

    def problem(self) -> tuple[str, str] | None:
        """The first parameter that cannot be true, as its name and a sentence; None if all can."""
        for name, (low, high, unit) in PARAMETER_LIMITS.items():
            value = getattr(self, name)
            if name == "window_c" and self.window_transmission == 1:
                continue  # without a window, some cameras leave its temperature unset
            if not low <= value <= high:  # false for NaN too
                return name, f"{value:g} is not between {low:g} and {high:g}{unit}"
        return None


PARAMETER_LIMITS = {
    "emissivity": (0.01, 1.0, ""),
    "distance_m": (0.0, 1e5, " m"),
    "reflected_c": (COLDEST_C, HOTTEST_C, " °C"),
    "atmospheric_c": (-100.0, 200.0, " °C"),
    "humidity": (0.0, 1.0, " (write 50 % as 0.5)"),
    "window_transmission": (0.01, 1.0, ""),
    "window_c": (COLDEST_C, HOTTEST_C, " °C"),
}
"""Smallest and largest value of each parameter, and its unit as written behind a number."""


class Planck(NamedTuple):
    """A camera's calibration: S = r1 / (r2 (exp(b / T) − f)) − o, for a black body of T kelvin and
    a signal S."""

    r1: float
    r2: float
    b: float
    f: float
    o: float

    def problem(self) -> str | None:
        """Why these cannot be a camera's constants; None if they can.

        b is the second radiation constant (14,388 µm K) over the effective wavelength: 500 K and
        20,000 K would be 29 µm and 0.7 µm.
        """
        if not all(math.isfinite(value) for value in self):
            return "not a number"
        if not (self.r1 > 0 and self.r2 > 0):
            return f"R1 = {self.r1:g}, R2 = {self.r2:g}"
        if not 500 <= self.b <= 20_000:
            return f"B = {self.b:g}"
        if not 0 < self.f <= 10:
            return f"F = {self.f:g}"
        return None

    def signal(self, celsius: float) -> float:
        """The signal of a black body, counts; infinite where the law's denominator vanishes."""
        with np.errstate(over="ignore", divide="ignore"):
            exponential = np.exp(np.float64(self.b) / (celsius + ZERO_CELSIUS_K))
            return float(self.r1 / (self.r2 * (exponential - self.f)) - self.o)

    def celsius(self, signal: Float64[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
        """The temperature of the black body with this signal, °C; not finite where there is
        none."""
        with np.errstate(all="ignore"):
            kelvin = self.b / np.log(self.r1 / (self.r2 * (signal + self.o)) + self.f)
            return np.where(signal + self.o > 0, kelvin - ZERO_CELSIUS_K, np.nan)


class Atmosphere(NamedTuple):
    """Constants of the transmission of air, as the camera stores them; ``x`` weighs the two
    exponentials."""

    alpha1: float
    alpha2: float
    beta1: float
    beta2: float
    x: float

    def transmission(self, distance_m: float, air_c: float, humidity: float) -> float:
        """The share of the object's radiation that reaches the camera.

        τ = x exp(−√d (α1 + β1 √ω)) + (1 − x) exp(−√d (α2 + β2 √ω)), with the water in the air
        ω = humidity · exp(1.5587 + 0.06939 t − 2.7816e-4 t² + 6.8455e-7 t³).
        """
        water = humidity * math.exp(
            1.5587 + 0.06939 * air_c - 2.7816e-4 * air_c**2 + 6.8455e-7 * air_c**3
        )
        root_d, root_w = math.sqrt(distance_m), math.sqrt(water)
        with np.errstate(all="ignore"):
            first = np.exp(-np.float64(root_d) * (self.alpha1 + self.beta1 * root_w))
            second = np.exp(-np.float64(root_d) * (self.alpha2 + self.beta2 * root_w))
            return float(self.x * first + (1 - self.x) * second)


@dataclass(frozen=True)
class Measurement:
    """The measurement formula for one photo: S = τ_w (ε τ S_obj + (1 − ε) τ S_refl + (1 − τ) S_atm)
    + (1 − τ_w) S_win.

    Attributes:
        planck: the camera's calibration.
        parameters: checked by ``ObjectParameters.problem``.
        transmission: τ of the air, over 0 to ``MAX_TRANSMISSION``.
    """

    planck: Planck
    parameters: ObjectParameters
    transmission: float

    def object_signal(self, signal: Float64[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
        """S_obj: the signal of the object's surface, were it black, and seen through nothing."""
        p, tau, at = self.parameters, self.transmission, self.planck.signal
        at_lens = signal
        if p.window_transmission < 1:
            at_lens = (
                signal - (1 - p.window_transmission) * at(p.window_c)
            ) / p.window_transmission
        surroundings = (1 - p.emissivity) * tau * at(p.reflected_c) + (1 - tau) * at(
            p.atmospheric_c
        )
        return (at_lens - surroundings) / (p.emissivity * tau)

    def celsius(self, signal: Float64[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
        """The object's temperature, °C; not finite where the signal is less than the surroundings'
        share of it."""
        return self.planck.celsius(self.object_signal(signal))


def object_temperature(
    raw: UInt16[np.ndarray, "h w"], measurement: Measurement
) -> tuple[Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Temperatures of a photo, and the mask of those that are measured.

    Masked are the two ends of the detector's numbers (0 and 65535: no data, saturated), and what
    has no temperature.
    """
    return masked(measurement.celsius(raw.astype(np.float64)), (raw > 0) & (raw < 65535))


def masked(
    celsius: Float64[np.ndarray, "h w"], usable: Bool[np.ndarray, "h w"] | None = None
) -> tuple[Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Temperatures with NaN where they are not usable or not plausible, and the mask of those that
    are."""
    with np.errstate(invalid="ignore"):
        valid = (celsius >= COLDEST_C) & (celsius <= HOTTEST_C)
    if usable is not None:
        valid &= usable
    return np.where(valid, celsius, np.nan).astype(np.float32), valid
