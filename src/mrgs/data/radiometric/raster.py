"""TIFF, PNG and JPEG images without a thermal record: finished temperatures, shades of grey, or a
colour palette."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from mrgs.data.files import scene_error
from mrgs.data.images import LUMINANCE, opened
from mrgs.data.radiometric.exif import ExifFacts
from mrgs.data.radiometric.measurement import masked
from mrgs.data.radiometric.photo import MAX_PIXELS, UNIT, Overrides, PhotoFacts, ThermalPhoto
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
    fitting = [
        text
        for text in candidates
        if are_everyday(*Unit.parse(text).celsius(np.array([low, middle, high])).tolist())
    ]
    if len(fitting) != 1:
        may_be = f"may be {' or '.join(fitting)}" if fitting else "fit no usual unit"
        example = (fitting or candidates)[0]
        raise scene_error(
            path,
            f"its numbers ({low:.5g} to {high:.5g}) {may_be}; give the unit, such as {example}",
            options=("unit",),
        )
    return fitting[0]


_GREY_TOLERANCE = 8
"""Channels that differ by no more than this many of 255 steps are the same shade, saved as a JPEG
in colour."""

_SATURATED, _MISSING = 65_535, -9_999
"""Integers that are no temperatures: the largest of 16 bits, and what programs write for a pixel
without value, or less."""

_RELATIVE = "relative values from 0 to 1 are used"


def read_raster(data: bytes, path: Path, exif: ExifFacts, overrides: Overrides) -> ThermalPhoto:
    """The photo in an image file, given its content.

    Raises:
        SceneError: damaged, of an unknown scale, or with bounds for what is not grey.
    """
    with opened(path, data, most_pixels=MAX_PIXELS) as image:
        kind, mode = str(image.format), image.mode
        plain = mode == "F" or mode.startswith("I")  # one channel, its array of floats or integers
        grey = "L" if mode in ("1", "L", "LA", "La") else "RGB"
        pixels = np.array(image if plain else image.convert(grey))
    facts = PhotoFacts(f"{kind} image", camera=exif.model, taken=exif.taken, gps=exif.gps)
    if pixels.ndim == 3:
        return _from_colours(pixels, path, facts, overrides)
    if mode == "F":
        return finished(pixels, FLOAT_UNITS, path, facts, overrides)
    if pixels.dtype == np.uint8:
        return _from_grey(pixels.astype(np.float32) / 255, path, facts, overrides)
    values = pixels.astype(np.float32)
    if overrides.bounds_c is not None:
        if values.min() < 0 or values.max() > 65535:
            raise scene_error(
                path,
                "holds integers that are no 16-bit shades of grey; give a unit instead of bounds",
                options=("unit", "bounds_c"),
            )
        return _from_grey(values / 65535, path, facts, overrides)
    values[(pixels == _SATURATED) | (pixels <= _MISSING)] = np.nan
    return finished(values, INTEGER_UNITS, path, facts, overrides)


def finished(
    values: Float[np.ndarray, "h w"],
    candidates: tuple[str, ...],
    path: Path,
    facts: PhotoFacts,
    overrides: Overrides,
) -> ThermalPhoto:
    """The photo of numbers that are temperatures in the given unit, or in the one candidate that is
    plausible.

    A single candidate is certain: the file says so.

    Raises:
        SceneError: the unit is not given and not plain, or no number is a temperature.
    """
    is_guessed = overrides.unit is None and len(candidates) > 1
    text = overrides.unit or (guess_unit(values, candidates, path) if is_guessed else candidates[0])
    with np.errstate(invalid="ignore"):  # damaged files hold signalling NaN
        celsius, valid = masked(Unit.parse(text).celsius(values.astype(np.float64)))
    if not valid.any():
        raise scene_error(
            path,
            f"none of its numbers is a temperature in {text}; give the right unit",
            options=("unit",),
        )
    notes = () if overrides.unit else (f"The numbers are taken for {text}.",)
    doubts = []
    if overrides.bounds_c is not None:
        doubts.append("bounds_c had no effect: the numbers are temperatures.")
    if is_guessed and text == "kelvin":
        doubts.append(
            "The numbers are taken for kelvin, because they would be very hot in °C: give the unit "
            "if they are."
        )
    facts = facts.adding(notes=notes, warnings=tuple(doubts), unit=text if is_guessed else None)
    return ThermalPhoto(celsius, None, valid, facts)


def _from_grey(
    values: Float32[np.ndarray, "h w"], path: Path, facts: PhotoFacts, overrides: Overrides
) -> ThermalPhoto:
    """Shades of grey, 0 to 1: temperatures if their bounds are given, else relative."""
    if overrides.unit is not None:
        raise scene_error(
            path,
            "holds shades of grey, not temperatures; give the °C of black and white as bounds",
            options=("bounds_c",),
        )
    everywhere = np.ones(values.shape, dtype=bool)
    if overrides.bounds_c is None:
        doubt = (
            f"The file holds shades of grey without a scale: {_RELATIVE}; absolute temperatures "
            f"need bounds (the °C of black and white) or radiometric files."
        )
        return ThermalPhoto(None, values, everywhere, facts.adding(warnings=(doubt,)))
    low, high = overrides.bounds_c
    return ThermalPhoto(low + values * np.float32(high - low), None, everywhere, facts)


def _from_colours(
    pixels: np.ndarray, path: Path, facts: PhotoFacts, overrides: Overrides
) -> ThermalPhoto:
    grey = pixels.astype(np.float32) @ LUMINANCE.numpy() / 255
    spread = pixels.max(axis=2).astype(int) - pixels.min(axis=2)
    if float(np.mean(spread > _GREY_TOLERANCE)) < 0.01:  # a printed logo may be coloured
        return _from_grey(grey, path, facts, overrides)
    if overrides.bounds_c is not None or overrides.unit is not None:
        raise scene_error(
            path,
            "shows a colour palette, which gives no absolute temperatures; export it in white-hot "
            "grey, or as 16-bit TIFF",
        )
    doubt = (
        f"The file shows colours and holds no temperatures: {_RELATIVE}. Brighter need not be "
        f"warmer. Absolute temperatures need radiometric files."
    )
    return ThermalPhoto(
        None, grey, np.ones(grey.shape, dtype=bool), facts.adding(warnings=(doubt,))
    )
