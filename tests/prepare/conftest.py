"""Folders of photos, written by hand."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from datetime import datetime
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.helpers.flir import FlirPhoto


@pytest.fixture(scope="session")
def flir() -> type:
    """Writes FLIR photos: ``flir(visible=...).jpeg()``."""
    return FlirPhoto


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


@pytest.fixture(scope="session")
def photo(flir) -> Callable[..., bytes]:
    """Writes a photo: ``photo("jpg" | "png" | "celsius" | "flir" | "flir with visible" | "dji",
    ...)``."""

    @cache
    def write(
        kind: str,
        size: tuple[int, int] = (16, 12),
        taken: datetime | None = None,
        model: str | None = None,
        orientation: int | None = None,
        focal_mm: float | None = None,
    ) -> bytes:
        facts = exif(taken, model, orientation)
        if focal_mm is not None:
            facts.get_ifd(0x8769)[0x920A] = focal_mm
        if kind.startswith("flir"):
            inside = jpeg(np.full((20, 24, 3), 90, np.uint8)) if "visible" in kind else None
            return flir(visible=inside, exif=facts).jpeg()
        width, height = size
        ramp = np.linspace(0, 1, width * height).reshape(height, width)
        file = io.BytesIO()
        if kind == "celsius":
            Image.fromarray((10 + 20 * ramp).astype(np.float32)).save(file, "TIFF", exif=facts)
        elif kind == "png":
            Image.fromarray((255 * ramp).astype(np.uint8)).save(file, "PNG", exif=facts)
        else:
            colours = np.stack([255 * ramp, 255 * ramp[::-1], 90 + 0 * ramp], axis=-1).astype(
                np.uint8
            )
            Image.fromarray(colours).save(file, "JPEG", exif=facts)
        data = file.getvalue()
        if kind == "dji":  # the camera's signal lies in APP3 segments
            data = data[:2] + b"\xff\xe3" + struct.pack(">H", 40_002) + bytes(40_000) + data[2:]
        return data

    return write


def jpeg(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG")
    return file.getvalue()


@pytest.fixture
def photos(tmp_path: Path, photo: Callable[..., bytes]) -> Callable[..., Path]:
    """Writes a folder of photos: ``photos({"rgb/a.jpg": "jpg", "notes.txt": b"...", "b.jpg":
    ("jpg", {...})})``."""

    def write(files: dict[str, object], name: str = "card") -> Path:
        root = tmp_path / name
        root.mkdir(exist_ok=True)
        for relative, what in files.items():
            path = root / relative
            path.parent.mkdir(parents=True, exist_ok=True)
            kind, options = what if isinstance(what, tuple) else (what, {})
            path.write_bytes(kind if isinstance(kind, bytes) else photo(kind, **options))
        return root

    return write
