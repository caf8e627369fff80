"""Units of the numbers in a file: multiples of °C, K or °F, given by the user or recognised by
plausibility."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mrgs.data.files import scene_error
from mrgs.data.radiometric.photo import UNIT
from mrgs.scene.radiometry import ZERO_CELSIUS_K, are_everyday

_ENOUGH = 100_000
"""Number of pixels from which the unit is recognised."""

FLOAT_UNITS = ("celsius", "kelvin")
INTEGER_UNITS = ("celsius*100", "kelvin*100", "celsius*10", "kelvin*10")


class Unit(NamedTuple):
    """A number is ``factor`` times the temperature on the scale of ``quantity``."""

    quantity: str
    factor: float

    @classmethod
    def parse(cls, text: str) -> Unit:
        """From ``celsius``, ``kelvin*100`` and so on, already checked."""
        known = UNIT.fullmatch(text)
        if known is None:
            raise ValueError(f"not a unit: {text}")
        return cls(known[1], float(known[2] or 1))

    def celsius(self, values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Numbers in this unit -> °C."""
        temperature = values / self.factor
        if self.quantity == "kelvin":
            return temperature - ZERO_CELSIUS_K
        return (temperature - 32) / 1.8 if self.quantity == "fahrenheit" else temperature


def guess_unit(values: Float[np.ndarray, "h w"], candidates: tuple[str, ...], path: Path) -> str:
    """The one unit in which most of the pixels are everyday temperatures.

    Zeros, -9999 and less, and numbers that are not finite do not count: files mark missing pixels
    with them.

    Raises:
        SceneError: no candidate fits, or more than one does.
    """
    known = values[np.isfinite(values) & (values != 0) & (values > -9999)]
    if known.size == 0:
        raise scene_error(path, "holds no number but 0; it is empty, export it again")
    low, middle, high = np.percentile(known[:: 1 + known.size // _ENOUGH], (1, 50, 99))
    fitting = [text for text in candidates if _is_everyday(Unit.parse(text), low, middle, high)]
    if len(fitting) != 1:
        may_be = f"may be {' or '.join(fitting)}" if fitting else "fit no usual unit"
        example = (fitting or candidates)[0]
        raise scene_error(
            path,
            f"its numbers ({low:.5g} to {high:.5g}) {may_be}; give the unit, such as {example}",
            options=("unit",),
        )
    return fitting[0]


def _is_everyday(unit: Unit, low: float, middle: float, high: float) -> bool:
    return are_everyday(*unit.celsius(np.array([low, middle, high])).tolist())
