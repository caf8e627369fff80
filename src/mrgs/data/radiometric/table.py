"""Temperatures as text: the CSV files that FLIR Tools, ResearchIR and spreadsheets write, in any
locale."""

from __future__ import annotations

import re
from itertools import groupby
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from mrgs.data.files import decoded_text, scene_error
from mrgs.data.radiometric.photo import Overrides, PhotoFacts, ThermalPhoto
from mrgs.data.radiometric.raster import finished
from mrgs.data.radiometric.units import FLOAT_UNITS

MAX_BYTES = 32 * 2**20
"""A table of 3 megapixels takes 25 MB; longer texts are refused, for they take minutes and
gigabytes."""

_NUMBER = re.compile(
    r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d{1,3})?|[+-]?(?:nan|inf)", re.IGNORECASE
)
_QUANTITIES = {"c": "celsius", "f": "fahrenheit", "k": "kelvin"}
_MENTIONED = (
    re.compile(r"(?:[°º]|\bdeg(?:rees?)?\b\.?|\bdeg(?=[CFK]\b))\s*([CFK])\b"),
    re.compile(r"\btemp\w*[\s.]*[(\[]\s*(?:[°º]\s*)?([CFK])\s*[)\]]", re.IGNORECASE),
    re.compile(r"\b(celsius|fahrenheit|kelvin)\b", re.IGNORECASE),
)
"""How texts beside the numbers mention a unit."""

_STATED = re.compile(r"\bunits?\b[\s\"':=;,(\[]*(?:[°º]\s*)?([CFK])\b", re.IGNORECASE)
"""How they say that it is that of the numbers."""

_SEPARATORS = (";", "\t", ",", " ")
"""The first that gives a table is the one; where it is no comma, commas are decimal commas."""

_WHOLE_AND_DECIMALS = re.compile(r"(?<![^,])([+-]?\d+),(\d+)(?![^,])")
_ACROSS, _DOWN = r"\W*(?:x|u|col\w*)\b", r"\W*(?:y|v|rows?|lines?)\b"
"""Headings of a pixel's column and of its row."""


def read_table(data: bytes, path: Path, overrides: Overrides) -> ThermalPhoto:
    """The photo in a table of numbers: the largest block of lines with equally many numbers, two or
    more.

    Lines before and after it are left out, and so is a text at the start of its lines; a unit that
    they name is that of the numbers. What is no number among as many numbers as in the other lines
    is a pixel without temperature. The separator is a semicolon, a tab, a comma or a blank; a comma
    inside quotes, or beside another separator, is a decimal comma, and where commas are both, every
    second one. Lines of three numbers may be a pixel's place and temperature. SceneError if there
    is no such block, or the numbers are no temperatures.

    Args:
        data: the file's content; see ``decoded_text`` for its encodings.
        overrides: ``unit``, where the numbers are not °C.
    """
    if len(data) > MAX_BYTES:
        raise scene_error(
            path,
            f"is a text of {len(data)} bytes, too long for a table of one photo; check the export",
        )
    lines = decoded_text(data).splitlines()
    possible = (each for each in _SEPARATORS if any(line.count(each) > 1 for line in lines))
    found = ((each, *_largest_block(lines, each)) for each in possible)
    separator, rows, beside = next((each for each in found if each[1]), ("", [], lines))
    if not rows:
        raise scene_error(
            path, "holds no table of numbers; export the temperatures of all pixels as CSV"
        )
    if separator == "," and _are_decimals(np.stack(rows)):
        lines = [_WHOLE_AND_DECIMALS.sub(r"\1.\2", line) for line in lines]
        rows, beside = _largest_block(lines, ",")
    values = _picture(np.stack(rows), beside, path)
    # Without indices, as spreadsheets and pandas write them.
    if len(values) > 2 and _counts(values[:, 0]):
        values = values[:, 1:]
    if values.shape[1] > 2 and _counts(values[0]):
        values = values[1:]
    candidates = units_named(beside) or FLOAT_UNITS
    return finished(values, candidates, path, PhotoFacts("table of temperatures"), overrides)


def _are_decimals(values: Float64[np.ndarray, "h w"]) -> bool:
    """Whether every second number is the decimals of the one before: these follow each other much
    more closely than the two of a pair."""
    whole, decimals = values[:, ::2], values[:, 1::2]
    if values.shape[1] % 2 or values.shape[1] < 4 or not np.isfinite(values).all():
        return False
    are_digits = (values % 1 == 0).all() and (decimals >= 0).all()
    steps, gaps = np.abs(np.diff(whole, axis=1)), np.abs(whole - decimals)
    return bool(are_digits and 2 * steps.sum() < gaps.sum())


def _picture(
    values: Float64[np.ndarray, "h w"], beside: list[str], path: Path
) -> Float64[np.ndarray, "rows columns"]:
    """The picture in lines of a pixel's place and temperature, NaN where a place is missing; any
    other table as it is. SceneError if no heading says which number is the row."""
    if values.shape[1] != 3:
        return values
    (first, i), (second, j) = (np.unique(values[:, at], return_inverse=True) for at in (0, 1))
    shape, size = (len(first), len(second)), len(first) * len(second)
    if min(shape) < 2 or not 0.75 * size < len(values) <= size:
        return values
    picture = np.full(shape, np.nan)
    picture[i, j] = values[:, 2]
    for line in beside:
        if re.match(_ACROSS + _DOWN, line, re.IGNORECASE):
            return picture.T
        if re.match(_DOWN + _ACROSS, line, re.IGNORECASE):
            return picture
    raise scene_error(path, "lists places and temperatures; name its columns x, y, t above them")


def numbers_in(cells: list[str]) -> int:
    """How many numbers a line holds, without a text in front and empty cells behind; 0 if others
    are among them."""
    cells = _without_empty_end(cells, 0)
    if cells and not _NUMBER.fullmatch(cells[0]):
        cells = cells[1:]
    return len(cells) if all(_NUMBER.fullmatch(cell) for cell in cells) else 0


def _without_empty_end(cells: list[str], least: int) -> list[str]:
    filled = (n for n in range(len(cells), least, -1) if cells[n - 1])
    return cells[: next(filled, least)]


def _cells(line: str, separator: str) -> list[str]:
    if separator == "," and '"' in line:  # quoted cells with a decimal comma
        line = re.sub(r'"([^"]*)"', lambda quoted: quoted[1].replace(",", "."), line)
    cells = [
        cell.strip().strip('"') for cell in line.split(separator if separator != " " else None)
    ]
    return cells if separator == "," else [cell.replace(",", ".") for cell in cells]


def _largest_block(
    lines: list[str], separator: str
) -> tuple[list[Float64[np.ndarray, " n"]], list[str]]:
    """The numbers of the longest run of lines with equally many of them, lines with gaps among
    these; and the lines beside it."""
    cells = [_cells(line, separator) for line in lines]
    counts = [numbers_in(each) for each in cells]
    runs = [(count, len(list(run))) for count, run in groupby(counts) if count > 1]
    if not runs:
        return [], []
    width, _ = max(runs, key=lambda run: run[0] * run[1])
    firsts = [each[0] for each, count in zip(cells, counts, strict=True) if count == width]
    labels = sum(_NUMBER.fullmatch(first) is None for first in firsts)
    rows = [_row(each, width, 2 * labels > len(firsts)) for each in cells]
    runs_of_rows = [
        [*run] for known, run in groupby(enumerate(rows), lambda each: each[1] is not None) if known
    ]
    longest = max(runs_of_rows, key=len)
    if 2 * len(longest) < sum(2 * count >= width for count in counts):
        return [], []  # lines of many lengths, as where only some numbers have a decimal comma
    first, last = longest[0][0], longest[-1][0] + 1
    block = [row for _, row in longest if row is not None]
    return block, [*lines[:first], *lines[last:]]


def _row(cells: list[str], width: int, is_labelled: bool) -> Float64[np.ndarray, " n"] | None:
    """The numbers of a line of so many, NaN where a cell holds none; None if most hold none."""
    if is_labelled:
        cells = cells[1:]
    cells = _without_empty_end(cells, width)
    values = [float(cell) if _NUMBER.fullmatch(cell) else np.nan for cell in cells]
    if len(values) != width or 2 * np.isnan(values).sum() > width:
        return None
    return np.array(values, dtype=np.float64)


def units_named(lines: list[str]) -> tuple[str, ...]:
    """The units that texts name: those that they say are of the numbers, else all that they
    mention."""
    for patterns in ((_STATED,), _MENTIONED):
        named = {
            found.lower()
            for line in lines
            for pattern in patterns
            for found in pattern.findall(line)
        }
        if named:
            return tuple(sorted({_QUANTITIES.get(name, name) for name in named}))
    return ()


def _counts(numbers: Float64[np.ndarray, " n"]) -> bool:
    """Whether each is the next of the one before; the first may be an empty corner."""
    known = numbers[1:] if np.isnan(numbers[0]) else numbers
    return len(known) > 1 and bool((np.diff(known) == 1).all())
