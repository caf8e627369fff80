"""Photos written by hand, with the facts in their EXIF data."""

from __future__ import annotations

import io
import struct
from datetime import datetime
from functools import cache

import numpy as np
from PIL import Image

from tests.helpers.flir import FlirPhoto


def exif(
    taken: datetime | None = None, model: str | None = None, orientation: int | None = None
) -> Image.Exif:
    found = Image.Exif()
    if model is not None:
        found[0x010F], found[0x0110] = ("DJI" if model.startswith("DJI") else "Maker"), model
    if orientation is not None:
        found[0x0112] = orientation
    if taken is not None:
        # Pillow writes no second directory into TIFF.
        found[0x0132] = found.get_ifd(0x8769)[0x9003] = taken.strftime("%Y:%m:%d %H:%M:%S")
    return found


@cache
def photo(
    kind: str,
    size: tuple[int, int] = (16, 12),
    taken: datetime | None = None,
    model: str | None = None,
    orientation: int | None = None,
    focal_mm: float | None = None,
) -> bytes:
    """A photo of a kind: "jpg", "png", "celsius", "flir", "flir with visible" or "dji"."""
    facts = exif(taken, model, orientation)
    if focal_mm is not None:
        facts.get_ifd(0x8769)[0x920A] = focal_mm
    if kind.startswith("flir"):
        inside = jpeg(np.full((20, 24, 3), 90, np.uint8)) if "visible" in kind else None
        return FlirPhoto(visible=inside, exif=facts).jpeg()
    width, height = size
    ramp = np.linspace(0, 1, width * height).reshape(height, width)
    file = io.BytesIO()
    if kind == "celsius":
        Image.fromarray((10 + 20 * ramp).astype(np.float32)).save(file, "TIFF", exif=facts)
    elif kind == "png":
        Image.fromarray((255 * ramp).astype(np.uint8)).save(file, "PNG", exif=facts)
    else:
        colours = np.stack([255 * ramp, 255 * ramp[::-1], 90 + 0 * ramp], axis=-1).astype(np.uint8)
        Image.fromarray(colours).save(file, "JPEG", exif=facts)
    data = file.getvalue()
    if kind == "dji":  # the camera's signal lies in APP3 segments
        data = data[:2] + b"\xff\xe3" + struct.pack(">H", 40_002) + bytes(40_000) + data[2:]
    return data


def jpeg(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG")
    return file.getvalue()
