"""Reads thermal photos of all kinds; another camera maker is another entry of ``READERS``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

from mrgs.data.files import read_bytes
from mrgs.data.images import NPY_SIGNATURE, TIFF_SIGNATURES
from mrgs.data.radiometric.dji import read_bare_numbers, read_r_jpeg
from mrgs.data.radiometric.exif import JPEG_SIGNATURE, flir_record, holds_dji_signal
from mrgs.data.radiometric.flir import FFF_SIGNATURES, read_flir
from mrgs.data.radiometric.photo import Overrides, ThermalPhoto
from mrgs.data.radiometric.raster import read_raster
from mrgs.data.radiometric.table import read_table
from mrgs.errors import scene_error

MAX_BYTES = 256 * 2**20

_RASTERS = (JPEG_SIGNATURE, b"\x89PNG\r\n\x1a\n", *TIFF_SIGNATURES, NPY_SIGNATURE)
_TABLE_SUFFIXES = {".csv", ".txt", ".tsv", ".asc"}

Kind = Literal["signal", "numbers", "table", "image"]
"""Content of a file: a camera's raw signal; bare numbers, or floats in an image; a table of
temperatures; any other image."""


class Reader(NamedTuple):
    """A kind of file.

    Attributes:
        recognises: whether a file is of this kind, from its beginning and path. Of a JPEG with
            FLIR's record the whole file is needed, else ``SceneError`` is raised.
        read: its photo; raises ``SceneError`` if it cannot be read.
        kind: what it holds, by which ``mrgs prepare`` finds thermal photos among others. An image
            may turn out to hold numbers, or to be a photo in visible light.
        needs_tool: whether only the maker's tool reads it, which computes the temperatures of a DJI
            R-JPEG here; a file that was made with it before is used instead.
    """

    recognises: Callable[[bytes, Path], bool]
    read: Callable[[bytes, Path, Overrides], ThermalPhoto]
    kind: Kind = "image"
    needs_tool: bool = False


class _ClosedFormat(NamedTuple):
    """A format that only the maker's program reads: the file's own suffix, if any, byte strings in
    it (the first at its beginning, unless it is a JPEG), its name, and what to do."""

    suffix: str | None
    signs: tuple[bytes, ...]
    name: str
    remedy: str

    def recognises(self, data: bytes, path: Path) -> bool:
        if self.suffix not in (None, path.suffix.lower()):
            return False
        if data.startswith(JPEG_SIGNATURE):
            return self.suffix is None and all(sign in data for sign in self.signs)
        return data.startswith(self.signs[0])

    def refuse(self, data: bytes, path: Path, overrides: Overrides) -> ThermalPhoto:
        """SceneError: the format and the program that reads it."""
        raise scene_error(
            path, f"has its temperatures in {self.name} format, which is not read: {self.remedy}"
        )


_CLOSED_FORMATS = (
    _ClosedFormat(None, (b"\xffIRB\0",), "InfraTec's IRB", "export CSV from IRBIS"),
    _ClosedFormat(None, (b"HDRI", b"HIPT"), "Hikmicro's", "export CSV from HIKMICRO Analyzer"),
    _ClosedFormat(None, (b"IJPEG\0",), "InfiRay's IJPEG", "export TIFF or CSV from its app"),
    _ClosedFormat(".bmt", (b"BM",), "Testo's BMT", "export the table from IRSoft as CSV"),
    _ClosedFormat(".is2", (b"",), "Fluke's IS2", "export CSV from Fluke Connect or SmartView"),
)

READERS = [
    Reader(
        lambda data, path: data.startswith(JPEG_SIGNATURE) and flir_record(data, path) is not None,
        read_flir,
        "signal",
    ),
    Reader(lambda data, _: holds_dji_signal(data), read_r_jpeg, "signal", needs_tool=True),
    Reader(lambda data, _: data.startswith(FFF_SIGNATURES), read_flir, "signal"),
    *(Reader(each.recognises, each.refuse, "signal", needs_tool=True) for each in _CLOSED_FORMATS),
    Reader(lambda data, _: data.startswith(_RASTERS), read_raster),
    Reader(lambda _, path: path.suffix.lower() in _TABLE_SUFFIXES, read_table, "table"),
    Reader(lambda _, path: path.suffix.lower() == ".raw", read_bare_numbers, "numbers"),
]
"""All kinds of files; the first that recognises a file reads it."""


def reader_of(data: bytes, path: Path) -> Reader | None:
    """The first of ``READERS`` that recognises a file; None if it is of no known kind. SceneError
    if FLIR's record in a JPEG is damaged."""
    return next((reader for reader in READERS if reader.recognises(data, path)), None)


def read_thermal_photo(path: str | Path, overrides: Overrides | None = None) -> ThermalPhoto:
    """The temperatures of a thermal photo, and what its file says besides. The content decides the
    kind, not the name. SceneError if the file cannot be read: empty, damaged, cut off, of an
    unknown kind or scale, or a DJI R-JPEG that DJI's tool does not read.

    Args:
        path: a FLIR radiometric JPEG or FFF file; a DJI R-JPEG; a TIFF, PNG or JPEG image; an array
            (``.npy``); a table (``.csv``, ``.txt``, ``.tsv``, ``.asc``); or the bare
            numbers of DJI's tool (``.raw``).
        overrides: what the user knows better than the file.
    """
    path, overrides = Path(path), overrides or Overrides()
    data = read_bytes(path, MAX_BYTES)
    if not data:
        raise scene_error(path, "is empty; copy the photo from the camera again")
    reader = reader_of(data, path)
    if reader is None:
        raise scene_error(
            path,
            "is not an image; thermal photos are JPEG, PNG, TIFF, FFF or NPY files, or tables "
            "(.csv)",
        )
    photo = reader.read(data, path, overrides)
    parameters = [name for name in overrides.of_parameters() if name not in photo.facts.given]
    meanings = [name for name in ("unit", "bounds_c") if getattr(overrides, name) is not None]
    if photo.facts.parameters is not None:
        unused, why = meanings, "the temperatures follow from the camera's signal"
    elif reader.needs_tool:
        unused, why = parameters + meanings, "the maker's tool computes the temperatures"
    else:
        unused, why = parameters, "the file holds finished numbers, not the camera's signal"
    if not unused:
        return photo
    doubt = f"{', '.join(unused)} had no effect: {why}."
    return replace(photo, facts=photo.facts.adding(warnings=(doubt,)))
