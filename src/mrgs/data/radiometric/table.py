"""Temperatures as text: CSV files of FLIR Tools, ResearchIR and spreadsheets, in any locale."""

from __future__ import annotations

import re
import unicodedata
from itertools import groupby
from pathlib import Path
from statistics import mode
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from mrgs.data.files import decoded_text
from mrgs.data.radiometric import units
from mrgs.data.radiometric.photo import Overrides, PhotoFacts, ThermalPhoto
from mrgs.data.radiometric.raster import SATURATED, finished
from mrgs.errors import scene_error

MAX_BYTES = 32 * 2**20
"""A table of 3 megapixels takes 25 MB; longer texts, which would take minutes, are refused."""

_NUMBER = re.compile(
    r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d{1,3})?|[+-]?(?:nan|inf)", re.IGNORECASE
)
_NO_TEXT = re.compile(rf"{_NUMBER.pattern}|\W*|[<>]=?[\d., ]+|#?n/?a|null|none", re.IGNORECASE)
"""A number, or what programs write for a pixel without temperature."""

_UNIT_BEHIND = re.compile(r"(?<=\d) *(?:° *)?([CFK])(?![\w.:])")
_THOUSANDS = re.compile(r"(?<=\d)[ '’](?=\d{3}(?!\d))")
_QUOTED = re.compile(r"\"[^\"]*\"|'[^']*'")
_WHOLE_AND_DECIMALS = re.compile(r"(?<![^,])([+-]?\d+),(\d+)(?![^,])")
_SEPARATORS = (";", "\t", ",", " ")
"""The first that gives a table is the one; where it is not a comma, commas are decimal commas."""

_HEADINGS = re.compile(r"(y|v|i|rows?|lines?|zeile)|(x|u|j|col\w*|spalte)|([tcfk]|temp.*|celsius)")
_NO_HEADING = re.compile(r"[\[(/].*|pixel|px|pos(?:ition)?|coord\w*|index|[\W\d_]")
"""Headings of a pixel's row, its column and its temperature, and what may be beside them."""

_OF_EXTRACTOR = ["x", "y", "temp (c)"]
"""Headings by FlirImageExtractor, whose x is the row."""


def read_table(data: bytes, path: Path, overrides: Overrides) -> ThermalPhoto:
    """The photo in a table of numbers: the largest block of lines with equally many cells, most of
    them numbers.

    Other lines are left out, and so is a text at the start of its lines; a unit that they name is
    that of the numbers, unless it is that of a number there. A cell that is not a number is a pixel
    without temperature. The separator is a semicolon, a tab, a comma or a blank; a comma inside
    quotes, or beside another separator, is a decimal comma, and where commas are both, every second
    one. Under headings lines may be a pixel's place and temperature. SceneError if there is no such
    block, or the numbers are not temperatures. Only ``unit`` of the ``overrides`` is used."""
    if len(data) > MAX_BYTES:
        raise scene_error(path, f"has {len(data)} bytes, too long for a photo's table; check it")
    text = decoded_text(data).replace("º", "°").replace("−", "-").replace("–", "-")
    lines = unicodedata.normalize("NFKC", text).splitlines()
    filled = [line for line in lines if line.strip(" ")]
    lines = filled if 3 * len(filled) < 2 * len(lines) else lines  # empty ones between all others
    possible = (each for each in _SEPARATORS if any(line.count(each) > 1 for line in lines))
    found = (_table([_cells(line, each) for line in lines], each == ",") for each in possible)
    table = next((each for each in found if each), None)
    if table is None:
        raise scene_error(path, "holds no table of numbers; export all temperatures as CSV")
    beside, rows = [*lines[: table.first], *lines[table.end :]], lines[table.first : table.end]
    values = _picture(table, beside, path)
    doubts = [f"Other lines of numbers are left out: {table.others}."] if table.others > 0 else []
    if np.isnan(values[[0, -1]]).all(axis=1).any():
        doubts.append("The first or the last line of the table holds no number: it is masked.")
    values = _without_indices(values, table.head != [], doubts)
    values[values == SATURATED] = np.nan
    in_cells = {f"unit {letter}" for line in rows for letter in _UNIT_BEHIND.findall(line)}
    named = units.units_named([*in_cells] or [*beside, table.rows[0][0]])
    if not (named or overrides.unit) and units.FAHRENHEIT.search("\n".join(beside)):
        doubts.append("A setting is in °F, but the unit of the temperatures is not named: give it.")
    is_plain = (values % 1 > 0).any() or units.everyday(units.FLOAT_UNITS, units.typical(values))
    candidates = named or (units.FLOAT_UNITS if is_plain else units.INTEGER_UNITS)
    facts = PhotoFacts("table of temperatures", warnings=tuple(doubts))
    return finished(values, candidates, path, facts, overrides)


def _cells(line: str, separator: str) -> list[str]:
    """Texts between separators, numbers with a point and without unit, quotes and thousands."""
    line = _UNIT_BEHIND.sub("", line)
    if separator == ",":
        line = _QUOTED.sub(lambda quoted: _with_point(quoted[0]), line)
    elif separator != " ":
        line = _THOUSANDS.sub("", line)
    return [_with_point(cell.strip(" \t\"'")) for cell in line.split(separator.strip(" ") or None)]


def _with_point(number: str) -> str:
    """A number in which the last of comma and point is that of the decimals."""
    if "," in number and "." in number:
        number = number.replace(min(",.", key=number.index), "")
    return number.replace(",", ".")


def numbers_in(cells: list[str]) -> int:
    """How many numbers a line holds; 0 if more of its cells hold something else."""
    count = sum(_NUMBER.fullmatch(cell) is not None for cell in cells)
    return count if 2 * count >= len(cells) - cells.count("") else 0


class _Table(NamedTuple):
    """Rows of cells without labels and empty ends; the line above; the first line and the one after
    the last; how many elsewhere look like rows."""

    rows: list[list[str]]
    head: list[str]
    first: int
    end: int
    others: int

    def values(self) -> Float64[np.ndarray, "h w"]:
        """The numbers; NaN where a cell holds none, or one that no camera stores."""
        rows = [[float(c) if _NUMBER.fullmatch(c) else np.nan for c in row] for row in self.rows]
        return np.where(np.abs(rows) < 1e9, rows, np.nan)


def _table(cells: list[list[str]], is_comma: bool) -> _Table | None:
    """The table in the cells of all lines. Where commas separate them, every second may be the
    decimals of the one before, behind the row's number or not: whole numbers then follow each other
    much more closely than the two of a pair. Few long lines have a point in a number then."""
    longest = max(map(len, cells), default=0)
    long = [each[1:] for each in cells if 2 * len(each) > longest]
    has_point = [any("." in cell and _NUMBER.fullmatch(cell) for cell in each) for each in long]
    is_comma = is_comma and 2 * sum(has_point) <= len(long)
    for start in (0, 1) if is_comma else ():
        table = _largest([[*each[:start], *_paired(each[start:])] for each in cells])
        if table and len(table.rows[0]) - start > 2:
            digits = max(len(cell.partition(".")[2]) for row in table.rows for cell in row)
            decimals, whole = np.modf(table.values()[:, start:])
            gaps = np.abs(whole - np.abs(decimals) * 10.0 ** min(digits, 9))
            if digits and 2 * np.nansum(np.abs(np.diff(whole, axis=1))) < np.nansum(gaps):
                return table
    return _largest(cells)


def _paired(cells: list[str]) -> list[str]:
    """Each whole number and the decimals behind it as one; unchanged if any has no decimals."""
    paired = _WHOLE_AND_DECIMALS.sub(r"\1.\2", ",".join(cells)).split(",")
    return cells if any(cell.lstrip("+-").isdecimal() for cell in paired) else paired


def _largest(cells: list[list[str]]) -> _Table | None:
    """The longest run of rows among lines; None if there is none, most hold texts, or more rows are
    elsewhere, as where only some numbers have a decimal comma."""
    counts = [numbers_in(each) for each in cells]
    length = mode([len(each) for each, n in zip(cells, counts, strict=True) if n > 1] or [0])
    full = [each for each, n in zip(cells, counts, strict=True) if n > 1 and len(each) == length]
    firsts = [each[0] for each in full]
    has_text = not all(map(_NO_TEXT.fullmatch, firsts))
    skipped = int(has_text and 2 * numbers_in(firsts) < len(firsts))
    width = max((n for each in full for n, cell in enumerate(each, 1) if cell), default=0) - skipped
    parts = [each[skipped:][:width] if len(each) == length else [] for each in cells]
    # Half of a row is numbers, or it holds no text; a lone one behind a label is a setting.
    are_rows = [
        part != [] and (2 * n >= width or (n * skipped == 0 and all(map(_NO_TEXT.fullmatch, part))))
        for part, n in zip(parts, counts, strict=True)
    ]
    runs = [list(run) for found, run in groupby(range(len(cells)), are_rows.__getitem__) if found]
    longest = max(runs, key=lambda run: sum(counts[at] for at in run), default=[])
    others = sum(n > 1 and 2 * n >= width for n in counts) - len(longest)
    plain = sum(all(map(_NO_TEXT.fullmatch, parts[at])) for at in longest)
    if not any(counts[at] for at in longest) or max(others, len(longest) - plain) > plain:
        return None
    first, end = longest[0], longest[-1] + 1
    while first and parts[first - 1] and not any(parts[first]):  # an empty line below a text
        first += 1
    return _Table(parts[first:end], parts[first - 1] if first else [], first, end, others)


def _picture(table: _Table, beside: list[str], path: Path) -> Float64[np.ndarray, "h w"]:
    """The numbers of a table, or of the places that its lines list. SceneError if it lists places
    without saying which number is what."""
    values = table.values()
    height, width = values.shape
    columns = next((found for line in beside if (found := columns_of(line, width))), None)
    values = _placed(values[:, columns]) if columns else values
    is_list, is_recording = height > 4 * width and width < 8, width > 16 * height
    if values.size == 0 or (not columns and (is_list or is_recording)):
        raise scene_error(
            path,
            f"has {height} lines of {width} numbers, which are not rows of a picture; write a file "
            f"for each frame, in rows, or each pixel once, below the headings x, y, t",
        )
    return values


def columns_of(line: str, width: int) -> list[int]:
    """Which numbers are a pixel's row, column and temperature, by a line of headings; the only one
    of unknown name is the temperature. Empty if the line does not say."""
    separator = next((each for each in _SEPARATORS if each in line), ",")
    cells = _cells(line.strip("# "), separator)[-width:]
    if cells == _OF_EXTRACTOR:
        return [0, 1, 2]
    found = [_HEADINGS.fullmatch(_NO_HEADING.sub("", cell.casefold())) for cell in cells]
    kinds = [match.lastindex if match else 0 for match in found]
    if 3 not in kinds and kinds.count(0) == 1:
        kinds[kinds.index(0)] = 3
    are_all = len(kinds) == width and all(kinds.count(kind) == 1 for kind in (1, 2, 3))
    return [kinds.index(kind) for kind in (1, 2, 3)] if are_all else []


def _placed(listed: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "rows columns"]:
    """The picture in lines of a row, a column and a temperature, NaN where a place is missing;
    empty if whole rows or most places are, or one has two temperatures."""
    listed = listed[np.isfinite(listed[:, :2]).all(axis=1)]
    (rows, i), (columns, j) = (np.unique(listed[:, at], return_inverse=True) for at in (0, 1))
    gaps = [np.diff(places) for places in (rows, columns)]
    are_even = all(len(gap) and gap.max() < 1.5 * gap.min() for gap in gaps)
    if not are_even or len(rows) * len(columns) > 4 * len(listed):
        return np.empty((0, 0))
    picture = np.full((len(rows), len(columns)), np.nan)
    picture[i, j] = listed[:, 2]
    return picture if np.array_equal(picture[i, j], listed[:, 2], equal_nan=True) else picture[:0]


def _without_indices(
    values: Float64[np.ndarray, "h w"], has_head: bool, doubts: list[str]
) -> Float64[np.ndarray, "rows columns"]:
    """The numbers without those of their rows and columns, as spreadsheets and pandas write them:
    even steps, other than those of the last column, that count from 0 or 1, or have a heading or an
    empty corner. A sentence about others is added to ``doubts``."""
    has_corner = bool(np.isnan(values[0, 0]))
    is_named = has_corner or has_head
    for name in ("column", "line"):
        known = values[int(np.isnan(values[0, 0])) :]
        numbers, steps, others = known[:, 0], np.diff(known[:, 0]), known[:, -1] - known[:, 0]
        tolerance = 0.05 * np.abs(steps).max(initial=0)
        if len(values) > 2 and np.ptp(steps) < tolerance and not np.ptp(others) < tolerance:
            if is_named or (numbers[0] in (0, 1) and np.median(steps) == 1):
                values = values[:, 1:]
            elif len(numbers) > 4:
                doubts.append(f"The first {name} has even steps: remove it if it is an index.")
        values, is_named = values.T, has_corner
    return values
