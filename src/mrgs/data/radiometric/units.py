"""Units of stored temperatures: stated by the maker's tags, given by the user, or guessed by
plausibility and reported as a guess."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mrgs.errors import scene_error
from mrgs.scene.radiometry import ZERO_CELSIUS_K, are_everyday

_ENOUGH = 100_000
"""Number of pixels from which the unit is recognised."""

_SCALE, _NUMBER = r"(celsius|kelvin|fahrenheit)", r"(\d+(?:\.\d+)?)"
_PLAIN = re.compile(rf"{_SCALE}(?:\*{_NUMBER})?([+-]{_NUMBER})?")
_SHIFTED = re.compile(rf"\({_SCALE}([+-]{_NUMBER})\)\*{_NUMBER}")

FLOAT_UNITS = ("celsius", "kelvin")
INTEGER_UNITS: tuple[str, ...] = (
    "celsius*100",
    "kelvin*100",
    "celsius*10",
    "kelvin*10",
    "kelvin*25",
    "kelvin*64",
    "(celsius+100)*40",
    "(celsius+100)*10",
    "(celsius+100)*100",
)
"""Units of cameras and converters; docs/radiometric.md names them."""

_QUANTITIES = {"c": "celsius", "f": "fahrenheit", "k": "kelvin"}
_MENTIONED = (
    re.compile(r"(?:°|\bdeg(?:rees?)?\b\.?|\bdeg(?=[CFK]\b))\s*([CFK])\b", re.IGNORECASE),
    re.compile(r"\b(?:(?:in|t)\W+|temp\w*\W*)([CFK])\b(?!:)", re.IGNORECASE),
    re.compile(r"\[\s*([CFK])\s*\]"),
    re.compile(r"\b(celsius|fahrenheit|kelvin)\b", re.IGNORECASE),
)
"""How texts mention a unit."""

_UNIT = r"(?:(?:°|[Dd]eg(?:rees?)?)[\s.]*)?([CFK])(?:elsius|ahrenheit|elvin)?\b"
_STATED = re.compile(rf"(?i)\bunits?[\s\"':=;,(\[]*(?:(0[.,]\d{{0,3}}[1-9])[\s*]*)?{_UNIT}")
"""How texts state that it is the unit of the numbers, or a decimal fraction of it."""

_SETTING = re.compile(rf"(?:^|[;,:=\t])[ \"']*[+-]?\d|\d *{_UNIT}")
"""A line with a number of its own: a unit in it is that of a setting."""

FAHRENHEIT = re.compile(r"(?i)(?:°|\bdeg(?:rees?)?[\s.]*|\d[.,]\d+\s*|\b\d+\s+)F\b|\bfahrenheit\b")
"""How texts mention °F, of whatever."""


class Unit(NamedTuple):
    """A stored number is ``factor`` × the temperature on the scale of ``quantity`` + ``addend``."""

    quantity: str
    factor: float = 1.0
    addend: float = 0.0

    @classmethod
    def parse(cls, text: str) -> Unit:
        """A unit from ``celsius``, ``kelvin*100``, ``celsius*40+4000`` or ``(celsius+100)*40``.
        ValueError for any other form, or a factor of 0."""
        compact = text.replace(" ", "").lower()
        if plain := _PLAIN.fullmatch(compact):
            unit = cls(plain[1], float(plain[2] or 1), float(plain[3] or 0))
        elif shifted := _SHIFTED.fullmatch(compact):
            unit = cls(shifted[1], float(shifted[4]), float(shifted[2]) * float(shifted[4]))
        else:
            raise ValueError(f"the unit {text!r} is not known")
        if unit.factor == 0:
            raise ValueError(f"the unit {text!r} has a factor of 0")
        return unit

    def celsius(self, values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Numbers in this unit -> °C."""
        temperature = (values - self.addend) / self.factor
        if self.quantity == "kelvin":
            return temperature - ZERO_CELSIUS_K
        return (temperature - 32) / 1.8 if self.quantity == "fahrenheit" else temperature


CELSIUS = Unit("celsius")


class Choice(NamedTuple):
    """The unit that numbers are read in, and what to say about the choice."""

    unit: Unit
    text: str
    doubts: tuple[str, ...] = ()


def typical(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "3"]:
    """The 1st, 50th and 99th percentile of the numbers that stand for a temperature: not zeros,
    -9999 and less, which mark missing pixels; NaN if there are none."""
    known = values[np.isfinite(values) & (values != 0) & (values > -9999)]
    if known.size == 0:
        return np.full(3, np.nan)
    return np.percentile(known[:: 1 + known.size // _ENOUGH], (1, 50, 99))


def zeros_are_missing(values: Float[np.ndarray, "h w"]) -> bool:
    """Whether there are zeros, far from other numbers, as around an image that was warped: what is
    as cold is next to what is half as cold."""
    low, _, high = typical(values)
    near = ((values > 0) & (values < low / 2)).sum()
    return bool(low > (high - low) / 4 and (values == 0).sum() > 10 * near)


def _is_everyday(unit: Unit, numbers: Float[np.ndarray, "3"]) -> bool:
    return are_everyday(*unit.celsius(numbers).tolist())


def everyday(candidates: tuple[str, ...], numbers: Float[np.ndarray, "3"]) -> list[str]:
    """The candidates in which typical numbers are everyday temperatures."""
    return [text for text in candidates if _is_everyday(Unit.parse(text), numbers)]


def units_named(lines: list[str]) -> tuple[str, ...]:
    """The units that texts beside numbers name: if any are stated to be of the numbers, these, else
    all that are mentioned in lines without a number of their own."""
    found = [match for line in lines for match in _STATED.findall(line)]
    for line in lines if not found else ():
        if not _SETTING.search(line):
            found += [("", name) for mentioned in _MENTIONED for name in mentioned.findall(line)]
    names = ((part.replace(",", "."), name.lower()) for part, name in found)
    factors = ((f"*{1 / float(part):g}" if part else "", name) for part, name in names)
    return tuple(sorted({_QUANTITIES.get(name, name) + factor for factor, name in factors}))


def given_unit(text: str, numbers: Float[np.ndarray, "3"]) -> Choice:
    """The unit that the user gives, for ``typical`` numbers. An addend is taken as it is written;
    where that gives no everyday temperatures, but the addend in °C or K does (``celsius*40+100``
    for ``(celsius+100)*40``), the latter is meant."""
    unit = Unit.parse(text)
    if unit.addend and "(" not in text and not _is_everyday(unit, numbers):
        meant = f"({unit.quantity}{unit.addend:+g})*{unit.factor:g}"
        shifted = unit._replace(addend=unit.addend * unit.factor)
        if _is_everyday(shifted, numbers):
            return Choice(shifted, meant, (f"The unit {text} is read as {meant}.",))
    return Choice(unit, text)


def stated_unit(candidates: tuple[str, ...], numbers: Float[np.ndarray, "3"]) -> Choice:
    """The unit of a known camera, for ``typical`` numbers: the first candidate, unless only another
    one gives everyday temperatures; with a doubt wherever another one does."""
    first, likely = candidates[0], everyday(candidates, numbers)
    text = likely[0] if len(likely) == 1 else first
    doubts = () if likely in ([], [first]) else (_doubt(text, candidates, numbers),)
    return Choice(Unit.parse(text), text, doubts)


def guessed_unit(
    candidates: tuple[str, ...], numbers: Float[np.ndarray, "3"], path: Path
) -> Choice:
    """The one unit in which ``typical`` numbers are everyday temperatures, with a doubt unless it
    is °C as such, and not all from 0 to 1. SceneError if there is no number, no candidate fits, or
    more than one does."""
    if np.isnan(numbers).any():
        raise scene_error(path, "has no number but 0; it is empty, export it again")
    likely = everyday(candidates, numbers)
    if len(likely) != 1:
        may_be = " or ".join(_in(text, numbers) for text in likely)
        low, _, high = numbers
        raise scene_error(
            path,
            f"its numbers ({low:.5g} to {high:.5g}) "
            f"{f'may be {may_be}' if likely else 'fit no usual unit'}; give the unit, such as "
            f"{(likely or candidates)[0]}",
            options=("unit",),
        )
    (text,) = likely
    doubts = () if text == "celsius" else (_doubt(text, candidates, numbers),)
    if text == "celsius" and numbers[0] >= 0 and numbers[2] <= 1:
        doubts = ("The numbers are from 0 to 1 and taken for °C: give the unit if they are.",)
    return Choice(Unit.parse(text), text, doubts)


def _doubt(text: str, candidates: tuple[str, ...], numbers: Float[np.ndarray, "3"]) -> str:
    """What the chosen unit gives, and the two others whose middle is nearest to 20 °C."""
    others = sorted(
        (other for other in candidates if other != text),
        key=lambda other: abs(Unit.parse(other).celsius(numbers)[1] - 20),
    )
    return (
        f"The unit of the numbers is not certain. They are taken for {_in(text, numbers)}, not for "
        f"{' or '.join(_in(other, numbers) for other in others[:2])}: give the unit."
    )


def _in(text: str, numbers: Float[np.ndarray, "3"]) -> str:
    low, _, high = Unit.parse(text).celsius(numbers)
    return f"{text} ({low:.1f} to {high:.1f} °C)".replace("-", "−")


_TLINEAR = re.compile(rb"TlinearGain(?:=[\"']|>)\s*([+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?)")
_BAND = re.compile(rb"BandName(?:=[\"']|>.{0,200}?<rdf:li>|>)\s*([^<>\"']{1,64})", re.DOTALL)
_THERMAL_BANDS = re.compile("LWIR|TIR|THERMAL.*")
_TLINEAR_K = (1e-4, 10.0)
"""Temperatures of one count that can be; cameras have 0.01, 0.04, 0.1 or 0.4 K."""

WIRIS_UNITS = ("(celsius+100)*40", "kelvin*25")
"""Units of Workswell's WIRIS cameras; the second is reported of models other than the WIRIS Pro."""

_BY_MAKER = (
    ("workswell", "wiris pro", WIRIS_UNITS, True),
    ("workswell", "", WIRIS_UNITS, False),
    ("flir", "", ("kelvin*25", "kelvin*2.5", "kelvin*100", "kelvin*10"), False),
)
"""Maker and beginning of the model, units of its TIFF files, whether the first is sure."""


def camera_units(
    make: str | None, model: str | None, xmp: bytes, path: Path
) -> tuple[tuple[str, ...], bool]:
    """Candidate units of a TIFF of integers, and whether its tags state the first; ``xmp`` is its
    metadata, or empty. SceneError if the tags say that the numbers are not temperatures."""
    band = (match[1].decode("latin-1").strip() if (match := _BAND.search(xmp)) else "").upper()
    if band and not _THERMAL_BANDS.fullmatch(band):
        raise scene_error(path, f"is the band {band} of a multispectral camera, no thermal photo")
    if gain := _TLINEAR.search(xmp):
        kelvin = float(gain[1].replace(b",", b"."))
        if not _TLINEAR_K[0] <= kelvin <= _TLINEAR_K[1]:
            raise scene_error(
                path,
                "has the detector's counts, not temperatures, by its tag TlinearGain; use the "
                "camera's radiometric JPEG",
                options=("unit",),
            )
        return (f"kelvin*{1 / kelvin:g}",), True
    maker, name = (make or "").lower(), (model or "").lower()
    if band and ("micasense" in maker or "sentera" in maker):
        return ("kelvin*100",), True
    for of_maker, of_model, units, is_stated in _BY_MAKER:
        if of_maker in maker and name.startswith(of_model):
            return units, is_stated
    return INTEGER_UNITS, False
