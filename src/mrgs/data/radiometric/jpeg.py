"""The application segments of a JPEG file, in which makers hide their measurements."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from mrgs.data.files import scene_error

SIGNATURE = b"\xff\xd8\xff"
APP1, APP3 = 0xE1, 0xE3
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9
_STANDALONE = {0x01, *range(0xD0, 0xD9)}

FLIR = b"FLIR\0"
_FLIR_HEADER = 8
"""``FLIR``, a null, a 1, the number of this part from 0, and the number of the last part."""

_DJI_RAW_BYTES = 16_384
"""More than this in APP3 segments of a DJI photo is its raw signal."""


class Segment(NamedTuple):
    """One segment: its marker's second byte, its content, and whether the file holds all of it."""

    marker: int
    content: bytes
    whole: bool


def segments(data: bytes) -> Iterator[Segment]:
    """The segments before the picture itself; stops where the bytes are no JPEG any more."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # fill bytes may precede a marker
            at += 1
        elif marker in _STANDALONE:
            at += 2
        elif marker in (_START_OF_SCAN, _END_OF_IMAGE):
            return
        else:
            end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
            yield Segment(marker, data[at + 4 : end], end <= len(data))
            at = max(end, at + 4)


def flir_record(data: bytes, path: Path) -> bytes | None:
    """FLIR's thermal record, put together from its parts; None if the photo has none.

    Raises:
        SceneError: parts are missing, repeated or cut off.
    """
    parts = [s for s in segments(data) if s.marker == APP1 and s.content.startswith(FLIR)]
    parts = [part for part in parts if len(part.content) >= _FLIR_HEADER]
    if not parts:
        return None
    last = parts[0].content[7]
    numbers = [part.content[6] for part in parts]
    # The number is one byte: it starts again at 0 after 255.
    if (
        numbers != [index & 0xFF for index in range(len(parts))]
        or numbers[-1] != last
        or not parts[-1].whole
    ):
        whole = sum(part.whole for part in parts)
        raise scene_error(
            path,
            f"its thermal record is cut off or damaged ({whole} of {last + 1} parts are whole); "
            "copy the photo from the camera again, without editing it",
        )
    return b"".join(part.content[_FLIR_HEADER:] for part in parts)


def holds_dji_signal(data: bytes, make: str | None) -> bool:
    """Whether this is a DJI R-JPEG: made by DJI, with the raw signal in APP3 segments."""
    if make is None or "DJI" not in make.upper():
        return False
    return sum(len(s.content) for s in segments(data) if s.marker == APP3) > _DJI_RAW_BYTES
