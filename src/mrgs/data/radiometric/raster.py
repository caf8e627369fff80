"""TIFF, PNG and JPEG without a thermal record: temperatures, shades of grey, or a palette."""

from __future__ import annotations

import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from mrgs.data.images import (
    LUMINANCE,
    TIFF_SIGNATURES,
    as_stored,
    holds_numbers,
    numbers_of,
    opened,
)
from mrgs.data.radiometric.exif import read_exif
from mrgs.data.radiometric.measurement import masked
from mrgs.data.radiometric.photo import Overrides, PhotoFacts, ThermalPhoto
from mrgs.data.radiometric.units import (
    FLOAT_UNITS,
    INTEGER_UNITS,
    camera_units,
    given_unit,
    guessed_unit,
    stated_unit,
    typical,
    zeros_are_missing,
)
from mrgs.errors import scene_error

_GREY_TOLERANCE = 8
"""Channels that differ by at most this many of 255 steps are one shade, saved as a colour JPEG."""

SATURATED, _MISSING = 65_535, -9_999
"""Integers that are not temperatures: the largest of 16 bits; this or less, for missing pixels."""

_NO_VALUE = -999.0
"""What some programs write for a pixel without value, as the smallest number of a picture."""

_RELATIVE = "relative values from 0 to 1 are used"


def read_raster(data: bytes, path: Path, overrides: Overrides) -> ThermalPhoto:
    """The photo in an image file, given its content. SceneError if it is damaged, of an unknown
    scale, or given bounds without being grey."""
    refuse_recording(_frames(data, path), path)
    with opened(path, data) as image:
        kind, mode, xmp = str(image.format), image.mode, image.info.get("xmp", b"")
        has_numbers = holds_numbers(image)
        if has_numbers or mode.startswith("I"):
            pixels = numbers_of(image, in_celsius=overrides.unit is None)
            if has_numbers and np.nanmin(pixels, initial=np.inf) == _NO_VALUE:
                pixels = np.where(pixels == _NO_VALUE, np.float32(np.nan), pixels)
        else:
            grey = "L" if mode in ("1", "L", "LA", "La") else "RGB"
            pixels = np.array(as_stored(image).convert(grey))
    exif = read_exif(data)
    facts = PhotoFacts(
        f"{kind} image", exif.model, exif.serial, exif.taken, exif.gps, exif.field_of_view_deg
    )
    if pixels.ndim == 3:
        return _from_colours(pixels, path, facts, overrides)
    if has_numbers:
        if zeros_are_missing(pixels):
            pixels = np.where(pixels == 0, np.float32(np.nan), pixels)
            facts = facts.adding(warnings=("Pixels of exactly 0 are taken for missing ones.",))
        return finished(pixels, FLOAT_UNITS, path, facts, overrides)
    if pixels.dtype == np.uint8:
        return _from_grey(pixels.astype(np.float32) / 255, path, facts, overrides)
    values = pixels.astype(np.float32)
    if overrides.bounds_c is not None:
        if values.min() < 0 or values.max() > 65535:
            raise scene_error(
                path,
                "holds integers that are not 16-bit shades of grey; give a unit instead of bounds",
                options=("unit", "bounds_c"),
            )
        return _from_grey(values / 65535, path, facts, overrides)
    values[(pixels == SATURATED) | (pixels <= _MISSING)] = np.nan
    candidates, is_stated = INTEGER_UNITS, False
    if overrides.unit is None:
        candidates, is_stated = camera_units(exif.make, exif.model, xmp, path)
    return finished(values, candidates, path, facts, overrides, is_stated)


def _frames(data: bytes, path: Path) -> int:
    """The number of pages of a TIFF, up to a thousand, if three or more are all of one size and
    type; else 1, as with a preview, a mask or smaller copies."""
    if not data.startswith(TIFF_SIGNATURES):
        return 1
    pages = []
    with warnings.catch_warnings(), opened(path, data) as image, suppress(Exception):
        warnings.simplefilter("ignore")  # of a damaged page, which ends them as the last does
        for number in range(1000):
            image.seek(number)
            pages.append((image.mode, image.size))
    return len(pages) if len(pages) > 2 and len({*pages}) == 1 else 1


def refuse_recording(frames: int, path: Path) -> None:
    """SceneError if a file holds several photos."""
    if frames > 1:
        what = f"is a recording of {frames} frames"
        raise scene_error(path, f"{what}; export the frames as files of their own")


def finished(
    values: Float[np.ndarray, "h w"],
    candidates: tuple[str, ...],
    path: Path,
    facts: PhotoFacts,
    overrides: Overrides,
    is_stated: bool = False,
) -> ThermalPhoto:
    """The photo of numbers that are temperatures in the unit given by the user, else in the one
    that the file states, else in the one candidate that is plausible. SceneError if the unit is not
    given and not plain, or no number is a temperature. ``is_stated`` if the file or its camera's
    model states the first candidate, as a single one always is."""
    usual = typical(values)
    is_stated = is_stated or len(candidates) == 1
    if overrides.unit is not None:
        chosen = given_unit(overrides.unit, usual)
    elif is_stated:
        chosen = stated_unit(candidates, usual)
    else:
        chosen = guessed_unit(candidates, usual, path)
    with np.errstate(invalid="ignore"):  # damaged files hold signalling NaN
        celsius, valid = masked(chosen.unit.celsius(values.astype(np.float64)))
    if not valid.any():
        raise scene_error(
            path,
            f"none of its numbers is a temperature in {chosen.text}; give the right unit",
            options=("unit",),
        )
    notes = () if overrides.unit else (f"The numbers are taken for {chosen.text}.",)
    doubts = chosen.doubts
    if overrides.bounds_c is not None:
        doubts += ("bounds_c had no effect: the numbers are temperatures.",)
    guess = None if is_stated or overrides.unit is not None else chosen.text
    facts = facts.adding(notes=notes, warnings=doubts, unit=guess, has_numbers=True)
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
    """An image in colours, 0 to 255: shades of grey if it has hardly any, else relative values."""
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
