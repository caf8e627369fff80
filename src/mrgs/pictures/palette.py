"""Colour maps from a few control colours, and scale bars with round numbers."""

from __future__ import annotations

import math
from functools import cache
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, UInt8
from scipy.interpolate import PchipInterpolator

from mrgs.system.wording import number_text

PaletteName = Literal[
    "inferno", "iron", "grey", "black-hot", "rainbow", "arctic", "lava", "depth", "error"
]

INVALID_COLOR = (208, 210, 214)
"""What is shown where a value is NaN."""

_CONTROL_COLORS: dict[PaletteName, str] = {
    # Dark to light with evenly rising lightness; close to matplotlib's map of this name.
    "inferno": "000004 140b34 390963 61136e 85216b a92e5e cb4149 e65d2f f78410 fcae12 f5db4b "
    "fcffa4",
    # What thermal cameras call iron: black, violet, red, orange, yellow, white.
    "iron": "000005 08106a 4a0c94 930f96 c52a66 e25624 f28a0a fabb1c fde36a ffffff",
    # White-hot, as thermographers say; and its reverse.
    "grey": "000000 ffffff",
    "black-hot": "ffffff 000000",
    # As makers of cameras have them: blue over white to gold; night blue over red to white.
    "arctic": "0a0a5c 1c3fb4 3f8be0 8fc9ee e8eef2 f2d39b e8a23c b8661a",
    "lava": "04101c 0f3b57 1d6a6a 8a2f2a c8341a ec6a14 f9ac28 fde27a ffffff",
    # Cold to warm by hue; for eyes used to it, since its lightness does not rise evenly.
    "rainbow": "1c1a7a 2457d6 1f9fe0 22c7b0 55cf5a b5d635 f2c52e f08a24 dc4120 8f1020",
    # For a scale that runs from far to near: near is light.
    "depth": "0b1026 15284b 1b4668 1d677d 2a8a89 54ac8c 8fca92 c9e4a6 f6f7cf",
    # Too cold, right, too warm; white at the centre.
    "error": "14336b 2a62ad 5f97cf a6c9e6 f7f7f7 f4b99f de7a5f b93540 6b1026",
}

PALETTES: tuple[PaletteName, ...] = get_args(PaletteName)


@cache
def palette_table(name: PaletteName) -> UInt8[np.ndarray, "256 3"]:
    """The 256 sRGB colours of a palette, by monotone cubic interpolation of its control colours."""
    colors = np.array(
        [list(bytes.fromhex(color)) for color in _CONTROL_COLORS[name].split()], dtype=np.float64
    )
    table = PchipInterpolator(np.linspace(0, 1, len(colors)), colors)(np.linspace(0, 1, 256))
    table = np.rint(table).astype(np.uint8)
    table.setflags(write=False)
    return table


def round_ticks(low: float, high: float, count: int = 6) -> list[float]:
    """Round numbers (1, 2, 2.5 or 5 times a power of ten apart) between the two limits, at most
    about ``count``."""
    low, high = min(low, high), max(low, high)
    step = tick_step(low, high, count)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(index * step, 12) + 0.0 for index in range(first, last + 1)]


def tick_step(low: float, high: float, count: int) -> float:
    """The smallest of 1, 2, 2.5 or 5 times a power of ten that divides the range into at most about
    ``count`` parts."""
    return round_up((high - low) / max(count, 1), (1, 2, 2.5, 5, 10))


def round_up(value: float, factors: tuple[float, ...] = (1, 2, 5, 10)) -> float:
    """The next of some ``factors``, which end with 10, times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value)) if value > 0 else 1.0
    return next(factor * power for factor in factors if factor * power >= value * (1 - 1e-9))


def tick_labels(ticks: list[float], decimal: str = ".") -> list[str]:
    """The ticks as text with one number of decimals, as few as tell them exactly (at most six),
    behind the sign ``decimal``."""
    for decimals in range(7):
        if all(
            math.isclose(round(tick, decimals), tick, rel_tol=1e-9, abs_tol=1e-9) for tick in ticks
        ):
            break
    return [number_text(tick, decimals).replace(".", decimal) for tick in ticks]


def display_range(values: Float[np.ndarray, "..."], tail: float = 0.5) -> tuple[float, float]:
    """The limits to show values between: percentiles ``tail`` and 100 − ``tail``, never equal."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = (float(limit) for limit in np.percentile(finite, [tail, 100 - tail]))
    margin = 1e-6 * max(1.0, abs(low), abs(high))
    return (low, high) if high - low > margin else (low - 0.5, high + 0.5)
