"""FLIR radiometric photos: from the thermal record, in the format FFF (a header, a directory, and
records of many types), to temperatures in °C.

The layout follows the tables that ExifTool documents (https://exiftool.org/TagNames/FLIR.html).
"""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, UInt16

from mrgs.data.images import opened
from mrgs.data.radiometric.exif import (
    JPEG_SIGNATURE,
    PNG_SIGNATURE,
    ExifFacts,
    clean_text,
    flir_record,
    read_exif,
)
from mrgs.data.radiometric.measurement import MAX_TRANSMISSION, Measurement, object_temperature
from mrgs.data.radiometric.photo import Overrides, PhotoFacts, ThermalPhoto, VisibleImage
from mrgs.data.radiometric.raster import finished, refuse_recording
from mrgs.data.radiometric.units import WIRIS_UNITS
from mrgs.errors import SceneError, scene_error
from mrgs.scene.air import Atmosphere
from mrgs.scene.radiometry import ZERO_CELSIUS_K, ObjectParameters, Planck

_IMAGE_OFFSET = 32
"""Raw data and embedded images follow a header of this many bytes."""

_SURROUNDINGS = ("reflected_c", "atmospheric_c", "window_c")
_KELVIN_AS_CELSIUS, _LIKELY_KELVIN = (250.0, 330.0), (200.0, 350.0)
"""A temperature of the surroundings between the first two, °C, is one in K: that of FLIR's cameras
for phones is 298; between the others, if it is a whole number of °C in K, such as 233.15."""

_MEDIAN_LIMITS_C = (-150.0, 3000.0)
"""A photo whose middle temperature is outside was not computed with its camera's constants."""

_JPEG_LS = b"\xff\xd8\xff\xf7"
"""How a raw image in JPEG-LS begins."""

_WORKSWELL = b"WWP"
"""Creator of a record whose numbers are temperatures; its Planck constants are all 0."""


def camera_facts(records: Records) -> ExifFacts:
    """Facts in a record about its camera, as EXIF data have them: model, serial number, time, and
    the field of view of the lens that was on it; none in a damaged one. Reads no pixels."""
    info = RecordFields.of(records.get(CAMERA_INFO) or b"")
    if info is None:
        return ExifFacts()
    view_deg, stamp = info.number(0x1B4), info.read(0x384, "IIh")
    taken = None
    if stamp is not None and stamp[0] != 0:  # in UTC, and the minutes that the camera is behind it
        seconds, milliseconds, behind = (int(number) for number in stamp)
        seconds -= 60 * behind if abs(behind) <= 14 * 60 else 0
        taken = datetime(1970, 1, 1) + timedelta(
            seconds=seconds, milliseconds=(milliseconds & 0xFFFF) % 1000
        )
    return ExifFacts(
        model=clean_text(info.data[0xD4:0xF4]),
        taken=taken,
        serial=clean_text(info.data[0x104:0x114]),
        field_of_view_deg=view_deg if view_deg is not None and 0 < view_deg < 180 else None,
    )


def read_flir(data: bytes, path: Path, overrides: Overrides) -> ThermalPhoto:
    """The photo in a JPEG with FLIR's thermal record, or in an FFF file, which is the bare record.
    SceneError if the record is cut off or damaged, or its constants are missing or implausible."""
    is_jpeg = data.startswith(JPEG_SIGNATURE)
    record = (flir_record(data, path) if is_jpeg else None) or data
    records, exif = Records(record, path), read_exif(data) if is_jpeg else ExifFacts()
    refuse_recording(1 if is_jpeg else 1 + data.count(data[:4], records.end), path)
    info = RecordFields.of(records.require(CAMERA_INFO, "camera info with the Planck constants"))
    if info is None:
        raise scene_error(path, "its camera info is damaged; copy the photo from the camera again")
    raw = raw_signal(records.require(RAW_DATA, "raw image"), path)
    facts = _facts(info, records, path, exif)
    if record[4:7] == _WORKSWELL:
        facts = replace(facts, source="Workswell radiometric JPEG")
        return finished(raw.astype(np.float32), WIRIS_UNITS, path, facts, overrides, True)
    planck = _planck(info, path)
    stored, given = _parameters(info, path), overrides.of_parameters()
    corrected = {}
    for name in _SURROUNDINGS:
        value = getattr(stored, name)
        low, high = _LIKELY_KELVIN if round(value % 1, 2) == 0.15 else _KELVIN_AS_CELSIUS
        if low <= value <= high:
            corrected[name] = round(value - ZERO_CELSIUS_K, 3)
    parameters = replace(stored, **{**corrected, **given})
    if problem := parameters.problem():
        name, sentence = problem
        raise scene_error(path, f"its {name} of {sentence}; give the true one", options=(name,))
    measurement = Measurement(planck, parameters, _transmission(info, parameters, path))
    celsius, valid = object_temperature(raw, measurement)
    low, high = _MEDIAN_LIMITS_C
    if not valid.any() or not low <= float(np.median(celsius[valid])) <= high:
        raise scene_error(
            path,
            f"its Planck constants, with {parameters.reflected_c:g} °C reflected, give no "
            f"plausible temperature; give the true reflected_c, or copy it again",
            options=("reflected_c",),
        )
    note = f"The air lets {100 * measurement.transmission:.1f} % of the radiation pass."
    facts = replace(
        facts,
        parameters=parameters,
        planck=planck,
        scale_c=_scale(info, measurement),
        notes=(note,),
    )
    said = [
        f"Its {name} of {getattr(stored, name):g} °C must be K: {value:g} °C is used; if it was so "
        f"hot, give it."
        for name, value in corrected.items()
        if name not in given and (name != "window_c" or stored.window_transmission < 1)
    ]
    facts = facts.adding(warnings=(*said, *_doubts(celsius, valid, facts)), given=given)
    return ThermalPhoto(celsius, None, valid, facts)


def raw_signal(record: bytes, path: Path) -> UInt16[np.ndarray, "h w"]:
    """The detector's counts in the record of the raw image: a PNG, JPEG-LS, or bare 16-bit numbers.
    SceneError if it is damaged, cut off or too large."""
    fields = RecordFields.of(record)
    size = None if fields is None else fields.read(2, "HH")
    if fields is None or size is None or 0 in size:
        raise scene_error(
            path, "the header of its raw image is damaged; copy the photo from the camera again"
        )
    width, height = int(size[0]), int(size[1])
    content = record[_IMAGE_OFFSET:]
    if content.startswith(PNG_SIGNATURE):
        return _smoother_order(_png_counts(content, width, height, path))
    if content.startswith(_JPEG_LS):
        return _smoother_order(_jpeg_ls_counts(content, width, height, path))
    if len(content) < 2 * width * height:
        raise cut_off(path, "raw image", len(content), 2 * width * height)
    counts = np.frombuffer(content, f"{fields.order}u2", width * height)
    return counts.reshape(height, width).astype(np.uint16)


def _png_counts(content: bytes, width: int, height: int, path: Path) -> UInt16[np.ndarray, "h w"]:
    with opened(path, content, ("PNG",)) as image:
        if image.size != (width, height) or not image.mode.startswith("I"):
            raise _unlike_announced(path, *image.size, f"type {image.mode}", width, height)
        return np.array(image).astype(np.uint16)


def _jpeg_ls_counts(
    content: bytes, width: int, height: int, path: Path
) -> UInt16[np.ndarray, "h w"]:
    bits, rows, columns, channels = struct.unpack_from(">BHHB", content.ljust(12, b"\0"), 6)
    if (columns, rows, channels) != (width, height, 1) or not 8 < bits <= 16:
        kind = f"{channels} × {bits} bits"
        raise _unlike_announced(path, columns, rows, kind, width, height)
    try:
        from jpeg_ls import decode_buffer
    except ImportError:
        raise scene_error(
            path, "its raw image is compressed with JPEG-LS, which needs `pip install pyjpegls`"
        ) from None
    try:
        counts, _ = decode_buffer(content)
    except RuntimeError as error:
        raise scene_error(
            path, f"its raw image cannot be decoded ({error}); copy the photo from the camera again"
        ) from None
    return np.frombuffer(counts, "<u2").reshape(height, width).astype(np.uint16)


def _unlike_announced(
    path: Path, columns: int, rows: int, kind: str, width: int, height: int
) -> SceneError:
    return scene_error(
        path,
        f"its raw image is {columns} x {rows} pixels of {kind}, where {width} x {height} of 16 "
        f"bits are announced; copy the photo from the camera again",
    )


def _smoother_order(values: UInt16[np.ndarray, "h w"]) -> UInt16[np.ndarray, "h w"]:
    """The counts with the order of bytes that the camera meant: PNG is big-endian, yet most of
    these cameras write little-endian; in the wrong order, each step of 1 becomes 256."""
    return min(
        (values.byteswap(), values),
        key=lambda each: sum(
            int(np.abs(np.diff(each.astype(np.int32), axis=axis)).sum()) for axis in (0, 1)
        ),
    )


def _planck(info: RecordFields, path: Path) -> Planck:
    o = info.read(0x308, "i")
    stored = [info.number(offset) for offset in (0x58, 0x30C, 0x5C, 0x60)] + [
        None if o is None else float(o[0])
    ]
    constants = [value for value in stored if value is not None]
    if len(constants) < len(stored) or not any(constants):
        raise scene_error(
            path,
            "its Planck constants are missing, without which there are no °C; use the photo as "
            "the camera saved it",
        )
    planck = Planck(*constants)
    if problem := planck.problem():
        fault = f"its Planck constants are implausible ({problem})"
        raise scene_error(path, f"{fault}; copy the photo from the camera again")
    return planck


def _parameters(info: RecordFields, path: Path) -> ObjectParameters:
    stored = [info.number(0x20), info.number(0x24), info.celsius(0x28), info.celsius(0x2C)]
    stored += [info.number(0x3C), info.celsius(0x30), info.number(0x34)]
    found = [value for value in stored if value is not None]
    if len(found) < len(stored):
        raise scene_error(path, "its camera info is cut off; copy the photo from the camera again")
    parameters = ObjectParameters(*found)
    if 1 < parameters.humidity <= 100:  # some cameras store per cent
        parameters = replace(parameters, humidity=parameters.humidity / 100)
    return parameters


def _transmission(info: RecordFields, parameters: ObjectParameters, path: Path) -> float:
    constants = info.read(0x70, "5f")
    air = None if constants is None else Atmosphere(*constants)
    tau = math.nan if air is None else air.transmission(
        parameters.distance_m, parameters.atmospheric_c, parameters.humidity
    )  # fmt: skip
    if not 0.01 <= tau <= MAX_TRANSMISSION:
        raise scene_error(
            path,
            f"the air between camera and object would let {tau:.3g} of the radiation pass; give "
            f"a distance of 0 m",
            options=("distance_m",),
        )
    return tau


def _facts(info: RecordFields, records: Records, path: Path, exif: ExifFacts) -> PhotoFacts:
    camera = camera_facts(records)
    visible, warnings = _visible(records, path)
    return PhotoFacts(
        source="FLIR radiometric JPEG" if exif != ExifFacts() else "FLIR thermal record",
        camera=camera.model or exif.model,
        serial=camera.serial,
        taken=exif.taken or camera.taken,
        gps=exif.gps,
        field_of_view_deg=camera.field_of_view_deg or exif.field_of_view_deg,
        calibrated_c=_range(info.celsius(0x94), info.celsius(0x90)),
        visible=visible,
        warnings=warnings,
    )


def _range(low: float | None, high: float | None) -> tuple[float, float] | None:
    if low is None or high is None or not -273.15 <= low < high <= 5000:
        return None
    return low, high


def _scale(info: RecordFields, measurement: Measurement) -> tuple[float, float] | None:
    """The ends of the printed colour scale; the camera stores middle and width in counts."""
    middle, width = info.read(0x338, "H"), info.read(0x33C, "H")
    if middle is None or width is None or width[0] == 0:
        return None
    ends = middle[0] + np.array([-0.5, 0.5]) * width[0]
    low, high = np.round(measurement.celsius(ends), 2).tolist()
    return _range(low, high)


def _visible(records: Records, path: Path) -> tuple[VisibleImage | None, tuple[str, ...]]:
    content = records.get(EMBEDDED_IMAGE)
    if content is None:
        return None, ()
    image = content[_IMAGE_OFFSET:]
    if not image.startswith((PNG_SIGNATURE, JPEG_SIGNATURE)):
        return None, (
            "The photo in visible light inside the file is of an unknown kind; left out.",
        )
    return VisibleImage(image, path), ()


def _doubts(
    celsius: Float32[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"], facts: PhotoFacts
) -> tuple[str, ...]:
    doubts = []
    if not valid.all():
        doubts.append(
            f"{100 * (1 - valid.mean()):.1f} % of the pixels have no temperature; they are masked."
        )
    if facts.calibrated_c is not None:
        low, high = facts.calibrated_c
        outside = float(np.mean((celsius[valid] < low) | (celsius[valid] > high)))
        if outside > 0.01:
            limits = f"{low:.0f} to {high:.0f} °C".replace("-", "−")
            doubts.append(
                f"{100 * outside:.0f} % of the pixels are outside the {limits} that the camera is "
                "calibrated for: their temperatures are rough."
            )
    return tuple(doubts)


FFF_SIGNATURES = (b"FFF\0", b"AFF\0")
RAW_DATA, EMBEDDED_IMAGE, CAMERA_INFO = 0x01, 0x0E, 0x20
_HEADER_BYTES = 64
_ENTRY_BYTES = 32
_MAX_ENTRIES = 4096

ByteOrder = Literal["<", ">"]


class RecordFields:
    """Numbers at given offsets of a record; None where the record is too short to hold them."""

    def __init__(self, data: bytes, order: ByteOrder) -> None:
        self.data = data
        self.order = order

    @classmethod
    def of(cls, record: bytes) -> RecordFields | None:
        """The fields of a record that starts with a small 16-bit number, in whose byte order they
        are; None if it does not."""
        if len(record) < 2 or (record[0] != 0) == (record[1] != 0):
            return None
        return cls(record, "<" if record[0] else ">")

    def read(self, offset: int, form: str) -> tuple[float | int, ...] | None:
        """The numbers of ``struct``'s ``form`` at ``offset``."""
        layout = struct.Struct(f"{self.order}{form}")
        is_whole = offset + layout.size <= len(self.data)
        return layout.unpack_from(self.data, offset) if is_whole else None

    def number(self, offset: int) -> float | None:
        """A 32-bit float as the shortest decimal that it represents, so that 0.95 is 0.95."""
        found = self.read(offset, "f")
        return None if found is None else float(str(np.float32(found[0])))

    def celsius(self, offset: int) -> float | None:
        """A temperature stored in K, in °C, to the mK."""
        kelvin = self.number(offset)
        return None if kelvin is None else round(kelvin - ZERO_CELSIUS_K, 3)


class Records:
    """The records of an FFF file by type, and where they ``end``; the first of a type counts, and
    free ones are left out. SceneError if header or directory are damaged or cut off."""

    def __init__(self, data: bytes, path: Path) -> None:
        self._data, self._path = data, path
        if len(data) < _HEADER_BYTES or data[:4] not in FFF_SIGNATURES:
            raise scene_error(
                path,
                "its thermal record does not start as FLIR's do; copy the photo from the camera "
                "again",
            )
        order: ByteOrder = ">" if 100 <= int.from_bytes(data[0x14:0x18], "big") < 256 else "<"
        offset, count = struct.unpack_from(f"{order}II", data, 0x18)
        if count > _MAX_ENTRIES:
            raise scene_error(
                path, f"its thermal record lists {count} parts; it is damaged, copy the photo again"
            )
        end = offset + count * _ENTRY_BYTES
        if end > len(data):
            raise cut_off(path, "directory", len(data), end)
        self._places: dict[int, slice] = {}
        self.end = end
        for start in range(offset, end, _ENTRY_BYTES):
            type_, at, length = struct.unpack_from(f"{order}H10xII", data, start)
            if type_ != 0:
                self.end = max(self.end, at + length)
                self._places.setdefault(type_, slice(at, at + length))

    def get(self, type_: int) -> bytes | None:
        """The content of a record; None if there is none, or it is cut off."""
        place = self._places.get(type_, slice(0))
        return None if place.stop > len(self._data) else self._data[place] or None

    def require(self, type_: int, what: str) -> bytes:
        """The content of a record. SceneError if there is none, or it is cut off."""
        if type_ not in self._places:
            problem = f"its thermal record holds no {what}; use the photo as the camera saved it"
            raise scene_error(self._path, problem)
        found = self.get(type_)
        if found is None:
            raise cut_off(self._path, what, len(self._data), self._places[type_].stop)
        return found


def cut_off(path: Path, what: str, there: int, wanted: int) -> SceneError:
    """The error of a record that ends too early."""
    return scene_error(
        path,
        f"its thermal record is cut off ({there} of {wanted} bytes of the {what}); copy the photo "
        f"again",
    )
