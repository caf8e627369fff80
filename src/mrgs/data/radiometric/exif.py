"""Facts in EXIF data: camera, time, position and orientation."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from PIL import Image
from PIL.ExifTags import IFD, Base

_TIMES = (
    (Base.DateTimeOriginal, Base.SubsecTimeOriginal),
    (Base.DateTimeDigitized, Base.SubsecTimeDigitized),
    (Base.DateTime, Base.SubsecTime),
)
"""Times, and their fractions of a second. The first that is a time counts: a camera whose clock was
not set fills one with zeros or blanks, and the last may be that of an edit."""

_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)


@dataclass(frozen=True)
class GpsPosition:
    """A position on WGS 84: degrees, north and east positive; metres above sea level, None if not
    known."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None = None


@dataclass(frozen=True)
class ExifFacts:
    """Facts in EXIF data; None where one is missing or damaged.

    Attributes:
        make: the maker of the camera.
        model: its model.
        taken: time by the camera's own clock, without a time zone.
        gps: position.
        orientation: how the camera was held, 1 to 8; 1 is upright, or not known.
    """

    make: str | None = None
    model: str | None = None
    taken: datetime | None = None
    gps: GpsPosition | None = None
    orientation: int = 1


def read_exif(data: bytes) -> ExifFacts:
    """The facts in the EXIF of an image file (JPEG, PNG or TIFF), given its content. Damage makes
    facts None."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of damaged tags; what is left is used
            with Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "TIFF")) as image:
                exif = image.getexif()
                return _facts(exif, exif.get_ifd(IFD.Exif), exif.get_ifd(IFD.GPSInfo))
    except Exception:  # Pillow's readers of damaged tags raise almost anything
        return ExifFacts()


def _facts(main: Mapping[int, Any], photo: Mapping[int, Any], gps: Mapping[int, Any]) -> ExifFacts:
    tags = {**photo, Base.DateTime: main.get(Base.DateTime)}
    times = (_time(tags.get(time), tags.get(fraction)) for time, fraction in _TIMES)
    taken = next((time for time in times if time is not None), None)
    orientation: Any = main.get(Base.Orientation)
    return ExifFacts(
        clean_text(main.get(Base.Make)),
        clean_text(main.get(Base.Model)),
        taken,
        _position(gps),
        int(orientation) if orientation in range(1, 9) else 1,
    )


def clean_text(value: object) -> str | None:
    """A short printable text from a file up to its first null; None if nothing is left."""
    text = (
        value.decode("latin-1")
        if isinstance(value, bytes)
        else value
        if isinstance(value, str)
        else ""
    )
    text = "".join(char for char in text.partition("\0")[0] if char.isprintable())
    return text.strip()[:64] or None


def _time(value: object, subseconds: object) -> datetime | None:
    try:
        moment = datetime.strptime(clean_text(value) or "", "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
    digits = clean_text(subseconds) or ""
    if not (digits.isascii() and digits.isdigit()):
        return moment
    return moment.replace(microsecond=int(digits[:6].ljust(6, "0")))


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
    side = clean_text(reference)
    try:
        degrees, minutes, seconds = (float(part) for part in value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    angle = degrees + minutes / 60 + seconds / 3600
    if side not in (positive, negative) or not (math.isfinite(angle) and 0 <= angle <= limit):
        return None
    return -angle if side == negative else angle
