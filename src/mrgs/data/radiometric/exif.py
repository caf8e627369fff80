"""EXIF data (camera, time, position, orientation), and the application segments of a JPEG file, in
which makers hide their measurements."""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image, UnidentifiedImageError
from PIL.ExifTags import IFD, Base

from mrgs.data.images import stored_size
from mrgs.errors import scene_error

_TIMES = (
    (Base.DateTimeOriginal, Base.SubsecTimeOriginal, Base.OffsetTimeOriginal),
    (Base.DateTimeDigitized, Base.SubsecTimeDigitized, Base.OffsetTimeDigitized),
    (Base.DateTime, Base.SubsecTime, Base.OffsetTime),
)
"""Times, their fractions of a second, and their zones. The first that is a time counts, as unset
clocks give zeros or blanks; the last, which an edit may change, only where no other is stated."""

_CLOCK = re.compile(
    r"(\d{4})[:/.-] ?(\d\d?)[:/.-] ?(\d\d?)(?: +|T)(\d\d?)[:.] ?(\d\d?)[:.] ?(\d\d?)"
    r"(?:[.,](\d+))?(?: ?(Z|UTC|GMT|[+-]\d\d:?(?:\d\d)?)| [A-Z]{3,4})?"
)

_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)


@dataclass(frozen=True)
class GpsPosition:
    """A position on WGS 84: degrees, north and east positive; metres above sea level, if known."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None = None


@dataclass(frozen=True)
class ExifFacts:
    """Facts in EXIF data; None where one is missing or damaged.

    Attributes:
        taken: time by the camera's own clock, without a time zone.
        zone_s: of that clock, seconds ahead of UTC.
        orientation: how the camera was held, 1 to 8; 1 is upright, or not known.
        field_of_view_deg: horizontal, from the focal length and the pixels' size on the sensor.
    """

    make: str | None = None
    model: str | None = None
    taken: datetime | None = None
    gps: GpsPosition | None = None
    orientation: int = 1
    serial: str | None = None
    focal_mm: float | None = None
    field_of_view_deg: float | None = None
    zone_s: float | None = None


def read_exif(data: bytes) -> ExifFacts:
    """The EXIF facts in the content of a JPEG, PNG or TIFF file; None where they are damaged."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of damaged tags; what is left is used
            try:
                with Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "TIFF")) as image:
                    exif, width = image.getexif(), stored_size(image)[0]
            except UnidentifiedImageError:  # a TIFF whose pixels Pillow does not know
                exif = Image.Exif()
                exif.load(data)
                width = exif.get(Base.ImageWidth, 0)
            gps = exif.get_ifd(IFD.GPSInfo)
            return _facts({**exif, **exif.get_ifd(IFD.Exif)}, gps, width)
    except Exception:  # Pillow's readers of damaged tags raise almost anything
        return ExifFacts()


def _facts(tags: Mapping[int, Any], gps: Mapping[int, Any], width: int) -> ExifFacts:
    """Facts from the tags of the main and of the Exif directory, which some cameras mix up."""
    stated = [each for each in _TIMES if re.search("[1-9]", clean_text(tags.get(each[0])) or "")]
    if len(stated) > 1:
        stated = [each for each in stated if each is not _TIMES[-1]]
    times = (_time(*map(tags.get, each)) for each in stated)
    taken, zone_s = next((time for time in times if time is not None), (None, None))
    orientation: Any = tags.get(Base.Orientation)
    focal_mm = _positive(tags.get(Base.FocalLength))
    serial = tags.get(Base.BodySerialNumber) or tags.get(Base.CameraSerialNumber)
    return ExifFacts(
        clean_text(tags.get(Base.Make)),
        clean_text(tags.get(Base.Model)),
        taken,
        _position(gps),
        int(orientation) if orientation in range(1, 9) else 1,
        clean_text(serial),
        focal_mm,
        _field_of_view_deg(tags, width, focal_mm),
        zone_s,
    )


_MM_PER_UNIT = {2: 25.4, 3: 10.0}
"""EXIF's units of resolution: inches and centimetres."""


def _positive(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < math.inf else None


def _field_of_view_deg(tags: Mapping[int, Any], width: int, focal_mm: float | None) -> float | None:
    pixels = _positive(tags.get(Base.FocalPlaneXResolution))
    unit_mm = _MM_PER_UNIT.get(tags.get(Base.FocalPlaneResolutionUnit, 2))
    if focal_mm is None or pixels is None or unit_mm is None:
        return None
    degrees = math.degrees(2 * math.atan(width * unit_mm / pixels / (2 * focal_mm)))
    return degrees if 1 < degrees < 150 else None


def clean_text(value: object) -> str | None:
    """A short printable text from a file up to its first null; None if nothing is left."""
    if isinstance(value, bytes):
        value = value.decode("latin-1")
    text = value if isinstance(value, str) else ""
    text = "".join(char for char in text.partition("\0")[0] if char.isprintable())
    return text.strip()[:64] or None


def _time(
    value: object, subseconds: object, offset: object
) -> tuple[datetime, float | None] | None:
    """A time by the camera's clock and that clock's zone, which some programs write behind it."""
    parts = _CLOCK.fullmatch(clean_text(value) or "")
    if parts is None:
        return None
    try:
        moment = datetime.strptime(":".join(parts.groups()[:6]), "%Y:%m:%d:%H:%M:%S")
    except ValueError:
        return None
    zone_s = None
    with suppress(ValueError):
        zone = {"UTC": "Z", "GMT": "Z"}.get(parts[8], parts[8]) or clean_text(offset) or ""
        zone += "00" if len(zone.rstrip(":")) == 3 else ""
        zone_s = -datetime.strptime(f"1970 {zone}", "%Y %z").timestamp()
    digits, _, whole = (clean_text(subseconds) or parts[7] or "").partition("/")
    if not (digits.isascii() and digits.isdigit()):
        return moment, zone_s
    if whole == "1000" and int(digits) < 1000:  # a ratio in place of digits
        digits = digits.zfill(3)
    return moment.replace(microsecond=int(digits[:6].ljust(6, "0"))), zone_s


def _position(gps: Mapping[int, Any]) -> GpsPosition | None:
    latitude = _degrees(gps.get(_LATITUDE), gps.get(_LATITUDE_REF), "N", "S", 90)
    longitude = _degrees(gps.get(_LONGITUDE), gps.get(_LONGITUDE_REF), "E", "W", 180)
    if latitude is None or longitude is None:
        return None
    if latitude == longitude == 0:  # what cameras write that have not found their place
        return None
    try:
        altitude_m = float(gps[_ALTITUDE])
        below = gps.get(_ALTITUDE_REF) in (1, b"\x01")
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return GpsPosition(latitude, longitude)
    plausible = -1e3 <= altitude_m <= 1e5
    return GpsPosition(
        latitude, longitude, (-altitude_m if below else altitude_m) if plausible else None
    )


def _degrees(
    value: Any, reference: object, positive: str, negative: str, limit: float
) -> float | None:
    side = (clean_text(reference) or "")[:1].upper()
    try:
        degrees, minutes, seconds = (float(part) for part in value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    angle = degrees + minutes / 60 + seconds / 3600
    if side not in (positive, negative) or not (math.isfinite(angle) and 0 <= angle <= limit):
        return None
    return -angle if side == negative else angle


JPEG_SIGNATURE, PNG_SIGNATURE = b"\xff\xd8\xff", b"\x89PNG"
_APP1, _APP3 = 0xE1, 0xE3
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9
_STANDALONE = {0x01, *range(0xD0, 0xD9)}

RECORD_MARKS = (b"FLIR\0", b"WORK\0")
"""How the parts of a thermal record in FLIR's format begin, by FLIR and by Workswell."""

_FLIR_HEADER = 8
"""The mark, a 1, the number of this part from 0, and the number of the last part."""

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
    """The thermal record in FLIR's format, put together from its parts; None if the photo has none.
    SceneError if parts are missing, repeated or cut off."""
    parts = [s for s in segments(data) if s.marker == _APP1 and s.content.startswith(RECORD_MARKS)]
    parts = [part for part in parts if len(part.content) >= _FLIR_HEADER]
    if not parts:
        return None
    if len(parts) <= 256:  # a program that wrote other segments may have changed their order
        parts.sort(key=lambda part: part.content[6])
    last = parts[0].content[7]
    numbers = [part.content[6] for part in parts]
    # The number is one byte: it starts again at 0 after 255. Workswell numbers no part.
    in_order = numbers == [index & 0xFF for index in range(len(parts))] and numbers[-1] == last
    is_numbered = parts[0].content.startswith(RECORD_MARKS[0])
    if (is_numbered and not in_order) or not all(part.whole for part in parts):
        whole = sum(part.whole for part in parts)
        raise scene_error(
            path,
            f"its thermal record is cut off or damaged ({whole} whole parts of {last + 1}); "
            "copy the photo from the camera again, without editing it",
        )
    return b"".join(part.content[_FLIR_HEADER:] for part in parts)


def holds_dji_signal(data: bytes) -> bool:
    """Whether this is a DJI R-JPEG: made by DJI, with the raw signal in APP3 segments."""
    if not data.startswith(JPEG_SIGNATURE) or "DJI" not in (read_exif(data).make or "").upper():
        return False
    return sum(len(s.content) for s in segments(data) if s.marker == _APP3) > _DJI_RAW_BYTES
