"""FLIR photos written by hand: every number in them is known."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass, field
from typing import Literal

import jpeg_ls
import numpy as np
from PIL import Image

PLANCK = {"r1": 15000.0, "r2": 0.0125, "b": 1400.0, "f": 1.0, "o": -6000}
PARAMETERS = {
    "emissivity": 0.95,
    "distance_m": 2.0,
    "reflected_c": 22.0,
    "atmospheric_c": 18.0,
    "window_c": 25.0,
    "window_transmission": 1.0,
    "humidity": 0.4,
}
ATMOSPHERE = (0.006569, 0.01262, -0.002276, -0.00667, 1.9)
ZERO_K = 273.15


def wave(height: int, width: int) -> np.ndarray:
    """Smooth counts between 14,000 and 18,000."""
    rows, columns = np.mgrid[:height, :width]
    return (16000 + 2000 * np.sin(rows / 5) * np.cos(columns / 7)).astype(np.uint16)


def png(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def jpg(pixels: np.ndarray, **options) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=90, **options)
    return file.getvalue()


@dataclass
class FlirPhoto:
    """What is written; ``info_fields`` puts packed bytes at offsets of the camera info,
    ``raw_content`` replaces the record of the raw image, and records in ``without`` are left
    out."""

    raw: np.ndarray = field(default_factory=lambda: wave(24, 32))
    storage: Literal["bare", "png", "swapped png", "jpeg-ls"] = "bare"
    order: Literal["<", ">"] = "<"
    planck: dict = field(default_factory=lambda: dict(PLANCK))
    parameters: dict = field(default_factory=lambda: dict(PARAMETERS))
    info_fields: dict[int, bytes] = field(default_factory=dict)
    visible: bytes | None = None
    part_bytes: int = 65_525
    exif: Image.Exif | None = None
    raw_content: bytes | None = None
    without: tuple[int, ...] = ()

    def camera_info(self) -> bytes:
        info = bytearray(0x470)
        height, width = self.raw.shape

        def put(offset: int, form: str, *values) -> None:
            struct.pack_into(f"{self.order}{form}", info, offset, *values)

        put(0, "3H", 2, width, height)
        p, planck = self.parameters, self.planck
        put(0x20, "2f", p["emissivity"], p["distance_m"])
        put(
            0x28, "3f", *(p[name] + ZERO_K for name in ("reflected_c", "atmospheric_c", "window_c"))
        )
        put(0x34, "f", p["window_transmission"])
        put(0x3C, "f", p["humidity"])
        put(0x58, "3f", planck["r1"], planck["b"], planck["f"])
        put(0x70, "5f", *ATMOSPHERE)
        put(0x90, "2f", 120 + ZERO_K, -20 + ZERO_K)
        put(0xD4, "32s", b"Test Camera")
        put(0x104, "16s", b"4711")
        put(0x308, "if", planck["o"], planck["r2"])
        put(0x338, "H", 16000)
        put(0x33C, "H", 2000)
        put(0x384, "II", 1_363_105_883, 250)
        for offset, content in self.info_fields.items():
            info[offset : offset + len(content)] = content
        return bytes(info)

    def raw_data(self) -> bytes:
        height, width = self.raw.shape
        header = struct.pack(f"{self.order}3H26x", 2, width, height)
        if self.storage == "bare":
            return header + self.raw.astype(f"{self.order}u2").tobytes()
        if self.storage == "jpeg-ls":
            return header + bytes(jpeg_ls.encode_array(self.raw))
        return header + png(self.raw.byteswap() if self.storage == "swapped png" else self.raw)

    def contents(self) -> dict[int, bytes]:
        """The records by type, but for those in ``without``."""
        found = {0x20: self.camera_info(), 0x01: self.raw_content or self.raw_data()}
        if self.visible is not None:
            found[0x0E] = struct.pack("<16H", 4, *[0] * 15) + self.visible
        return {kind: found[kind] for kind in found if kind not in self.without}

    def record(self) -> bytes:
        """The FFF file: header, directory (big-endian), records."""
        contents = self.contents()
        at = 64 + 32 * (len(contents) + 1)
        directory = bytes(32)  # a free entry
        for kind, content in contents.items():
            directory += struct.pack(">HHIIII12x", kind, 1, 100, 1, at, len(content))
            at += len(content)
        header = (
            b"FFF\0" + b"test".ljust(16, b"\0") + struct.pack(">III", 100, 64, len(contents) + 1)
        )
        return header.ljust(64, b"\0") + directory + b"".join(contents.values())

    def jpeg(self, record: bytes | None = None) -> bytes:
        """The photo: a small picture, with the record in parts behind its first segment."""
        record = self.record() if record is None else record
        parts = [record[at : at + self.part_bytes] for at in range(0, len(record), self.part_bytes)]
        segments = b""
        for index, part in enumerate(parts):
            content = b"FLIR\0\1" + bytes([index & 0xFF, (len(parts) - 1) & 0xFF]) + part
            segments += b"\xff\xe1" + struct.pack(">H", len(content) + 2) + content
        options = {} if self.exif is None else {"exif": self.exif}
        picture = jpg(np.zeros((8, 8, 3), dtype=np.uint8), **options)
        return picture[:2] + segments + picture[2:]
