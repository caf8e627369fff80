"""The header of one file in a folder of photos: what it shows, which camera took it, and when."""

from __future__ import annotations

import io
import math
import warnings
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Literal

from PIL import Image

from mrgs.data.files import read_bytes
from mrgs.data.radiometric import ExifFacts, dji, fff, jpeg, read_exif
from mrgs.data.radiometric.read import MAX_BYTES
from mrgs.errors import SceneError

Kind = Literal["signal", "numbers", "table", "image", "dji"]
"""A FLIR photo with the camera's raw signal; temperatures in an image file or in DJI's bare
numbers; a table of temperatures; any other image; a DJI R-JPEG. In this order one is preferred
where several show the same."""

PREFERENCE: tuple[Kind, ...] = ("signal", "numbers", "table", "image", "dji")

_HEAD_BYTES = 2**20
"""The header of a JPEG without a thermal record rarely takes more."""

_RASTERS = (jpeg.SIGNATURE, b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_TABLES = {".csv", ".txt", ".tsv"}
_TABLE_COLUMNS = 8
"""A table of temperatures has a line of at least so many cells."""

_UNSUPPORTED = {
    ".heic", ".heif", ".avif", ".webp", ".bmp", ".gif", ".dng", ".cr2", ".cr3", ".nef", ".arw",
    ".raf", ".orf", ".rw2",
}  # fmt: skip
_EXIF_IFD, _FOCAL_LENGTH = 0x8769, 0x920A


@dataclass(frozen=True)
class Photo:
    """A file that can be a photo of a pair.

    Attributes:
        path: the file.
        origin: path of the camera's original file without the extension, relative to the folder of
            photos.
        kind: what it holds.
        size: width and height in pixels; None where the header does not tell.
        embedded: whether a photo in visible light lies inside.
        exif: facts about the photo.
        focal_mm: focal length of the lens; None if the file does not say.
    """

    path: Path
    origin: PurePosixPath
    kind: Kind
    size: tuple[int, int] | None = None
    embedded: bool = False
    exif: ExifFacts = field(default_factory=ExifFacts)
    focal_mm: float | None = None

    @property
    def is_thermal(self) -> bool:
        """Whether the content says that it is thermal; a plain image may be, too."""
        return self.kind != "image"


def inspect(path: Path, relative: PurePosixPath) -> Photo | str:
    """The photo in a file, or why it is none (half a sentence).

    Args:
        path: the file.
        relative: its path below the folder of photos.
    """
    try:
        return _inspect(path, relative)
    except SceneError as error:
        return str(error).removeprefix(f"{path}: ")


def _inspect(path: Path, relative: PurePosixPath) -> Photo | str:
    suffix, origin = path.suffix.lower(), relative.with_suffix("")
    start = _start(path, _HEAD_BYTES)
    if not start:
        return "is empty; copy it again"
    if start.startswith(jpeg.SIGNATURE):
        return _jpeg(path, origin, start)
    if start.startswith(fff.SIGNATURES):
        records = fff.Records(read_bytes(path, MAX_BYTES), path)
        return Photo(path, origin, "signal", embedded=records.get(fff.EMBEDDED_IMAGE) is not None)
    if start.startswith(_RASTERS):
        return _raster(path, origin, read_bytes(path, MAX_BYTES))
    if suffix in _TABLES and _is_wide(start):
        return Photo(path, origin, "table")
    if suffix == ".raw" and path.stat().st_size in {
        width * height * n for width, height in dji.SIZES for n in (2, 4)
    }:
        return Photo(path, origin, "numbers")
    if suffix in _UNSUPPORTED:
        return f"is a {suffix[1:].upper()} file, which is not read; save it as JPEG or PNG"
    return "is no photo"


def _start(path: Path, count: int) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(count)
    except OSError as error:
        raise SceneError(
            f"cannot be read ({error.strerror}); check that it is there and readable"
        ) from None


def _jpeg(path: Path, origin: PurePosixPath, start: bytes) -> Photo | str:
    """A JPEG: only a thermal record, or an unusually long header, makes it worth reading the whole
    file."""
    if jpeg.FLIR in start:
        data = read_bytes(path, MAX_BYTES)
        record = jpeg.flir_record(data, path)
        records = None if record is None else fff.Records(record, path)
        # A whole record without a raw image belongs to a photo in visible light.
        if records is not None and records.get(fff.RAW_DATA) is not None:
            embedded = records.get(fff.EMBEDDED_IMAGE) is not None
            return Photo(path, origin, "signal", None, embedded, read_exif(data))
        return _raster(path, origin, data)
    photo = _raster(path, origin, start)
    return _raster(path, origin, read_bytes(path, MAX_BYTES)) if isinstance(photo, str) else photo


def _raster(path: Path, origin: PurePosixPath, data: bytes) -> Photo | str:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # of damaged tags; the photo's pixels are judged when they are read
            with Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "TIFF")) as image:
                size, mode = image.size, image.mode
                focal_mm = _focal_mm(image.getexif().get_ifd(_EXIF_IFD).get(_FOCAL_LENGTH))
    except Exception:  # Pillow's readers of damaged headers raise almost anything
        return "cannot be decoded as an image; copy or export it again"
    exif = read_exif(data)
    if mode == "F" or mode.startswith("I"):
        return Photo(path, origin, "numbers", size, exif=exif)
    if jpeg.holds_dji_signal(data, exif.make):
        return Photo(path, origin, "dji", size, exif=exif)
    return Photo(path, origin, "image", size, exif=exif, focal_mm=focal_mm)


def _focal_mm(value: object) -> float | None:
    try:
        focal_mm = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return focal_mm if math.isfinite(focal_mm) and focal_mm > 0 else None


def _is_wide(start: bytes) -> bool:
    text = start.decode(
        "utf-16" if start.startswith((b"\xff\xfe", b"\xfe\xff")) else "latin-1", errors="replace"
    )
    lines = text.splitlines()[:100]
    return any(line.count(separator) >= _TABLE_COLUMNS for line in lines for separator in ";\t,")
