"""The header of a file in a folder of photos: content, camera and time."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

from PIL import Image
from PIL.ExifTags import IFD, Base

from mrgs.data.files import read_bytes
from mrgs.data.radiometric import ExifFacts, dji, fff, flir, jpeg, read_exif
from mrgs.data.radiometric.exif import clean_text
from mrgs.data.radiometric.read import MAX_BYTES, Kind, reader_of
from mrgs.errors import SceneError

PREFERENCE: tuple[Kind, ...] = ("signal", "numbers", "table", "image", "dji")
"""In this order one file is preferred where several show the same."""

_HEAD_BYTES = 2**20
"""The header of a JPEG without a thermal record rarely takes more."""

_TABLE_COLUMNS = 8
"""A table of temperatures has a line of at least so many cells."""

_UNSUPPORTED = {
    ".heic", ".heif", ".avif", ".webp", ".bmp", ".gif", ".dng", ".cr2", ".cr3", ".nef", ".arw",
    ".raf", ".orf", ".rw2",
}  # fmt: skip


@dataclass(frozen=True)
class Photo:
    """A file that can be a photo of a pair.

    Attributes:
        path: the file.
        origin: path of the camera's original file without the extension, relative to the folder of
            photos.
        kind: what it holds.
        size: width and height in pixels; None if the header does not say.
        embedded: whether a photo in visible light lies inside.
        exif: facts about the photo.
        focal_mm: focal length in mm; None if the file does not say.
        field_of_view_deg: horizontal, of the thermal camera's lens; None if the file does not say.
        serial: the camera's serial number; None if the file does not say.
    """

    path: Path
    origin: PurePosixPath
    kind: Kind
    size: tuple[int, int] | None = None
    embedded: bool = False
    exif: ExifFacts = field(default_factory=ExifFacts)
    focal_mm: float | None = None
    field_of_view_deg: float | None = None
    serial: str | None = None

    @property
    def is_thermal(self) -> bool:
        """Whether the content is thermal for certain; a plain image may be thermal as well."""
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
    data = _head(path)
    if not data:
        return "is empty; copy it again"
    reader = reader_of(data, path)
    if reader is None and suffix in _UNSUPPORTED:
        return f"is a {suffix[1:].upper()} file, which is not read; save it as JPEG or PNG"
    if reader is None:
        return "is no photo"
    return _PHOTOS[reader.kind](path, origin, data)


def _head(path: Path) -> bytes:
    """The beginning of a file, from which its kind is recognised; the whole file for a JPEG with
    FLIR's record, which may be longer."""
    try:
        with path.open("rb") as file:
            start = file.read(_HEAD_BYTES)
    except OSError as error:
        raise SceneError(
            f"cannot be read ({error.strerror}); check that it is there and readable"
        ) from None
    has_record = start.startswith(jpeg.SIGNATURE) and jpeg.FLIR in start
    return read_bytes(path, MAX_BYTES) if has_record else start


def _signal(path: Path, origin: PurePosixPath, data: bytes) -> Photo | str:
    """A camera's signal; FLIR's record, in a JPEG or in a file of its own, is parsed."""
    is_jpeg = data.startswith(jpeg.SIGNATURE)
    record = jpeg.flir_record(data, path) if is_jpeg else None
    if data.startswith(fff.SIGNATURES):
        record = read_bytes(path, MAX_BYTES)
    exif = read_exif(data) if is_jpeg else ExifFacts()
    if record is None:  # another maker's
        return Photo(path, origin, "signal", exif=exif)
    records = fff.Records(record, path)
    if is_jpeg and records.get(fff.RAW_DATA) is None:  # a photo in visible light
        return _image(path, origin, data)
    camera = flir.camera_facts(records)
    return Photo(
        path,
        origin,
        "signal",
        embedded=records.get(fff.EMBEDDED_IMAGE) is not None,
        exif=replace(exif, taken=exif.taken or camera.taken),
        field_of_view_deg=camera.field_of_view_deg,
        serial=camera.serial,
    )


def _image(path: Path, origin: PurePosixPath, data: bytes) -> Photo | str:
    """An image file. Only an unusually long header makes a JPEG worth reading to its end."""
    photo = _raster(path, origin, data) if data.startswith(jpeg.SIGNATURE) else ""
    return _raster(path, origin, read_bytes(path, MAX_BYTES)) if isinstance(photo, str) else photo


def _table(path: Path, origin: PurePosixPath, data: bytes) -> Photo | str:
    return Photo(path, origin, "table") if _is_wide(data) else "is no photo"


def _bare_numbers(path: Path, origin: PurePosixPath, data: bytes) -> Photo | str:
    sizes = {width * height * n for width, height in dji.SIZES for n in (2, 4)}
    is_whole = path.suffix.lower() != ".raw" or path.stat().st_size in sizes
    return Photo(path, origin, "numbers") if is_whole else "is no photo"


_PHOTOS: dict[Kind, Callable[[Path, PurePosixPath, bytes], Photo | str]] = {
    "signal": _signal,
    "numbers": _bare_numbers,
    "table": _table,
    "image": _image,
    "dji": _image,
}
"""The function that inspects a file of each kind."""


def _raster(path: Path, origin: PurePosixPath, data: bytes) -> Photo | str:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # of damaged tags; the photo's pixels are judged when they are read
            with Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "TIFF")) as image:
                size, mode = image.size, image.mode
                details = image.getexif().get_ifd(IFD.Exif)
                focal_mm = _focal_mm(details.get(Base.FocalLength))
                serial = clean_text(details.get(Base.BodySerialNumber))
    except Exception:  # Pillow's readers of damaged headers raise almost anything
        return "cannot be decoded as an image; copy or export it again"
    exif = read_exif(data)
    kind: Kind = "image"
    if mode == "F" or mode.startswith("I"):
        kind = "numbers"
    elif jpeg.holds_dji_signal(data, exif.make):
        kind = "dji"
    return Photo(path, origin, kind, size, exif=exif, focal_mm=focal_mm, serial=serial)


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
