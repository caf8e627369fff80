"""Photos and tables as cameras' programs and spreadsheets write them."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

ORIGINAL, EDITED, ZONE = 0x9003, 0x0132, 0x9011


def numbers(values: np.ndarray, separator: str, decimal: str = ".", head: str = "") -> str:
    """A table of numbers with one decimal."""
    rows = [separator.join(f"{value:.1f}".replace(".", decimal) for value in row) for row in values]
    return head + "\n".join(rows) + "\n"


def places(values: np.ndarray, heading: str, down_first: bool = False) -> str:
    """A line for each pixel: its place and its temperature."""
    height, width = values.shape
    lines = [heading] if heading else []
    for y in range(height):
        for x in range(width):
            place = (y, x) if down_first else (x, y)
            lines.append(f"{place[0]},{place[1]},{values[y, x]:.1f}")
    return "\n".join(lines) + "\n"


def timed_jpeg(original: str | None, edited: str | None = None, zone: str | None = None) -> bytes:
    """A JPEG with these texts as its times and its zone."""
    exif = Image.Exif()
    details = exif.get_ifd(0x8769)
    if original is not None:
        details[ORIGINAL] = original
    if zone is not None:
        details[ZONE] = zone
    if edited is not None:
        exif[EDITED] = edited
    file = io.BytesIO()
    Image.fromarray(np.arange(192, dtype=np.uint8).reshape(12, 16)).save(file, "JPEG", exif=exif)
    return file.getvalue()


def raw_photo() -> bytes:
    """The beginning of a camera's raw file, which is a TIFF with a preview."""
    file = io.BytesIO()
    Image.fromarray(np.zeros((8, 10, 3), np.uint8)).save(file, "TIFF")
    return file.getvalue()


def with_parts_reversed(jpeg: bytes) -> bytes:
    """A FLIR photo whose record's parts are in the opposite order."""
    parts, others, at = [], [], 2
    while jpeg[at + 1] != 0xDA:
        end = at + 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
        (parts if jpeg[at + 4 : end].startswith(b"FLIR\0") else others).append(jpeg[at:end])
        at = end
    assert len(parts) > 1
    return jpeg[:2] + b"".join([*others, *reversed(parts)]) + jpeg[at:]
