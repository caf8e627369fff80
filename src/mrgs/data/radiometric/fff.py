"""FLIR's file format FFF: a header, a directory, and records of many types.

The layout follows the tables that ExifTool documents (https://exiftool.org/TagNames/FLIR.html).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from mrgs.data.files import scene_error
from mrgs.errors import SceneError
from mrgs.scene.radiometry import ZERO_CELSIUS_K

SIGNATURES = (b"FFF\0", b"AFF\0")
RAW_DATA, EMBEDDED_IMAGE, CAMERA_INFO, PICTURE_IN_PICTURE = 0x01, 0x0E, 0x20, 0x2A
_HEADER_BYTES = 64
_ENTRY_BYTES = 32
_MAX_ENTRIES = 4096

ByteOrder = Literal["<", ">"]


class RecordFields:
    """Numbers at given offsets of a record; None where the record is too short to hold them."""

    def __init__(self, data: bytes, order: ByteOrder) -> None:
        self.data = data
        self.order = order

    def read(self, offset: int, form: str) -> tuple[float | int, ...] | None:
        """The numbers of ``struct``'s ``form`` at ``offset``."""
        end = offset + struct.calcsize(f"{self.order}{form}")
        return (
            struct.unpack(f"{self.order}{form}", self.data[offset:end])
            if end <= len(self.data)
            else None
        )

    def number(self, offset: int) -> float | None:
        """A 32-bit float as the shortest decimal number that it represents, so that 0.95 is
        0.95."""
        found = self.read(offset, "f")
        return None if found is None else float(str(np.float32(found[0])))

    def celsius(self, offset: int) -> float | None:
        """A temperature stored in K, in °C, to the mK."""
        kelvin = self.number(offset)
        return None if kelvin is None else round(kelvin - ZERO_CELSIUS_K, 3)


def order_of(record: bytes) -> ByteOrder | None:
    """Byte order of a record that starts with a small 16-bit number; None if it does not."""
    if len(record) < 2 or (record[0] != 0) == (record[1] != 0):
        return None
    return "<" if record[0] else ">"


class _Entry(NamedTuple):
    type: int
    offset: int
    length: int


class Records:
    """The records of an FFF file by type; the first of each type counts."""

    def __init__(self, data: bytes, path: Path) -> None:
        self._data = data
        self._path = path
        self._entries = {entry.type: entry for entry in reversed(_directory(data, path))}

    def get(self, type_: int) -> bytes | None:
        """The content of a record; None if there is none, or it is cut off."""
        entry = self._entries.get(type_)
        if entry is None or entry.length == 0 or entry.offset + entry.length > len(self._data):
            return None
        return self._data[entry.offset : entry.offset + entry.length]

    def require(self, type_: int, what: str) -> bytes:
        """The content of a record.

        Raises:
            SceneError: there is none, or it is cut off.
        """
        entry = self._entries.get(type_)
        if entry is None:
            raise scene_error(
                self._path,
                f"its thermal record holds no {what}; use the photo as the camera saved it",
            )
        found = self.get(type_)
        if found is None:
            raise cut_off(self._path, what, len(self._data), entry.offset + entry.length)
        return found


def cut_off(path: Path, what: str, there: int, wanted: int) -> SceneError:
    """The error of a record that ends too early."""
    return scene_error(
        path,
        f"its thermal record is cut off ({there} of {wanted} bytes of the {what}); copy the photo "
        f"again",
    )


def _directory(data: bytes, path: Path) -> list[_Entry]:
    """All records but the free ones.

    Raises:
        SceneError: the header or the directory is damaged or cut off.
    """
    if len(data) < _HEADER_BYTES or data[:4] not in SIGNATURES:
        raise scene_error(
            path,
            "its thermal record does not start as FLIR's do; copy the photo from the camera again",
        )
    order: ByteOrder = ">" if 100 <= int.from_bytes(data[0x14:0x18], "big") < 200 else "<"
    offset, count = struct.unpack_from(f"{order}II", data, 0x18)
    if count > _MAX_ENTRIES:
        raise scene_error(
            path, f"its thermal record lists {count} parts; it is damaged, copy the photo again"
        )
    end = offset + count * _ENTRY_BYTES
    if end > len(data):
        raise cut_off(path, "directory", len(data), end)
    entries = []
    for start in range(offset, end, _ENTRY_BYTES):
        type_, at, length = struct.unpack_from(f"{order}H10xII", data, start)
        if type_ != 0:
            entries.append(_Entry(type_, at, length))
    return entries
