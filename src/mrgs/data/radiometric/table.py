"""Temperatures as text: the CSV files that FLIR Tools, ResearchIR and spreadsheets write, in any
locale."""

from __future__ import annotations

import re
from itertools import groupby
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from mrgs.data.files import scene_error
from mrgs.data.radiometric.photo import Overrides, PhotoFacts, ThermalPhoto
from mrgs.data.radiometric.raster import finished
from mrgs.data.radiometric.units import FLOAT_UNITS

MAX_BYTES = 32 * 2**20
"""A table of 3 megapixels takes 25 MB; longer texts are refused, for they take minutes and
gigabytes."""

_NUMBER = re.compile(
    r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d{1,3})?|[+-]?(?:nan|inf)", re.IGNORECASE
)
_FAHRENHEIT = re.compile(r"°\s?F\b|\bfahrenheit\b", re.IGNORECASE)
_SEPARATORS = (";", "\t", ",")
"""The first that a line holds several times is the one; where it is no comma, commas are decimal
commas."""


def read_table(data: bytes, path: Path, overrides: Overrides) -> ThermalPhoto:
    """The photo in a table of numbers: the largest block of lines with equally many numbers, two or
    more.

    Lines before and after it are left out, and so is a text at the start of its lines. The
    separator is a semicolon, a tab or a comma; a comma inside quotes, or beside another separator,
    is a decimal comma.

    Args:
        data: the file's content; UTF-8, UTF-16 with a byte-order mark, or Latin-1.
        path: the file, for messages.
        overrides: ``unit``, where the numbers are not °C.

    Raises:
        SceneError: there is no such block, or the numbers are no temperatures.
    """
    if len(data) > MAX_BYTES:
        raise scene_error(
            path,
            f"is a text of {len(data)} bytes, too long for a table of one photo; check the export",
        )
    lines = _decoded(data).splitlines()
    separator = next((s for s in _SEPARATORS if any(line.count(s) > 1 for line in lines)), None)
    rows, header = ([], "") if separator is None else _largest_block(lines, separator)
    if not rows:
        raise scene_error(
            path, "holds no table of numbers; export the temperatures of all pixels as CSV"
        )
    values = _without_indices(np.stack(rows))
    candidates = ("fahrenheit",) if _FAHRENHEIT.search(header) else FLOAT_UNITS
    return finished(values, candidates, path, PhotoFacts("table of temperatures"), overrides)


def _decoded(data: bytes) -> str:
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _numbers(line: str, separator: str) -> Float64[np.ndarray, " n"]:
    """The numbers of a line, without a text in front and an empty cell behind; empty if others are
    among them."""
    cells = _cells(line, separator)
    if cells and not cells[-1]:
        cells.pop()
    if cells and not _NUMBER.fullmatch(cells[0]):
        cells.pop(0)
    numeric = all(_NUMBER.fullmatch(cell) for cell in cells)
    return np.array([float(cell) for cell in cells] if numeric else [], dtype=np.float64)


def _cells(line: str, separator: str) -> list[str]:
    if separator == "," and '"' in line:  # quoted cells with a decimal comma
        line = re.sub(r'"([^"]*)"', lambda quoted: quoted[1].replace(",", "."), line)
    cells = [cell.strip().strip('"') for cell in line.split(separator)]
    return cells if separator == "," else [cell.replace(",", ".") for cell in cells]


def _largest_block(lines: list[str], separator: str) -> tuple[list[Float64[np.ndarray, " n"]], str]:
    """The numbers of the longest run of lines with equally many of them, and the text before it."""
    numbered = [(index, _numbers(line, separator)) for index, line in enumerate(lines)]
    blocks = [
        list(block) for count, block in groupby(numbered, lambda item: len(item[1])) if count > 1
    ]
    if not blocks:
        return [], ""
    largest = max(blocks, key=lambda block: len(block) * len(block[0][1]))
    return [numbers for _, numbers in largest], "\n".join(lines[: largest[0][0]])


def _without_indices(values: Float64[np.ndarray, "h w"]) -> Float64[np.ndarray, "y x"]:
    """Without a first column and a first row that only count, as spreadsheets and pandas write
    them."""
    if len(values) > 2 and (np.diff(values[:, 0]) == 1).all():
        values = values[:, 1:]
    if values.shape[1] > 2 and (np.diff(values[0]) == 1).all():
        values = values[1:]
    return values
