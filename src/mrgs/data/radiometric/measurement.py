"""From the signal of an infrared detector to the temperature of what it looks at.

Planck's law in the form of a camera's calibration, and the measurement formula with its reflected,
atmospheric and window terms are in the user manuals of FLIR's cameras, chapter "The measurement
formula"; the transmission of the air is FLIR's, with the constants that its cameras store. Both are
discussed in W. Minkina and S. Dudzik, *Infrared Thermography*, Wiley 2009.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt16

from mrgs.scene.radiometry import COLDEST_C, HOTTEST_C, ObjectParameters, Planck
from mrgs.system.memory import CHUNK_ROWS

MAX_TRANSMISSION = 1.05
"""The empirical formula may exceed 1 by a little in damp, warm air."""


@dataclass(frozen=True)
class Measurement:
    """The measurement formula for one photo: S = τ_w (ε τ S_obj + (1 − ε) τ S_refl + (1 − τ) S_atm)
    + (1 − τ_w) S_win. The ``parameters`` are checked by ``ObjectParameters.problem``;
    ``transmission`` is τ of the air, over 0 to ``MAX_TRANSMISSION``."""

    planck: Planck
    parameters: ObjectParameters
    transmission: float

    def celsius(self, signal: Float64[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
        """The object's temperature, °C, by S_obj, the signal that its surface would give if it were
        black and seen through nothing; not finite where its surroundings give more signal."""
        p, tau, at = self.parameters, self.transmission, self.planck.signal
        at_lens = signal
        if p.window_transmission < 1:
            of_window = (1 - p.window_transmission) * at(p.window_c)
            at_lens = (signal - of_window) / p.window_transmission
        reflected = (1 - p.emissivity) * tau * at(p.reflected_c)
        surroundings = reflected + (1 - tau) * at(p.atmospheric_c)
        return self.planck.celsius((at_lens - surroundings) / (p.emissivity * tau))


def object_temperature(
    raw: UInt16[np.ndarray, "h w"], measurement: Measurement
) -> tuple[Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Temperatures of a photo, and the mask of those that are measured: of counts other than 0 (no
    data) and 65535 (saturated) that have a temperature."""
    step = max(1, CHUNK_ROWS // raw.shape[1])  # a few rows at a time, which take little memory
    parts = [
        masked(measurement.celsius(rows.astype(np.float64)), (rows > 0) & (rows < 65535))
        for rows in (raw[start : start + step] for start in range(0, len(raw), step))
    ]
    celsius, valid = map(np.concatenate, zip(*parts, strict=True))
    return celsius, valid


def masked(
    celsius: Float64[np.ndarray, "h w"], usable: Bool[np.ndarray, "h w"] | None = None
) -> tuple[Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Temperatures, NaN where not usable or not plausible, and the mask of those that are."""
    with np.errstate(invalid="ignore"):
        valid = (celsius >= COLDEST_C) & (celsius <= HOTTEST_C)
    if usable is not None:
        valid &= usable
    return np.where(valid, celsius, np.nan).astype(np.float32), valid
