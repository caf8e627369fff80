"""FLIR radiometric photos: from the thermal record to temperatures in °C."""

from __future__ import annotations

import io
import math
from datetime import datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, UInt16

from mrgs.data.files import scene_error
from mrgs.data.radiometric.exif import ExifFacts, clean_text
from mrgs.data.radiometric.fff import (
    CAMERA_INFO,
    EMBEDDED_IMAGE,
    PICTURE_IN_PICTURE,
    RAW_DATA,
    RecordFields,
    Records,
    cut_off,
    order_of,
)
from mrgs.data.radiometric.measurement import (
    MAX_TRANSMISSION,
    Atmosphere,
    Measurement,
    object_temperature,
)
from mrgs.data.radiometric.photo import Overrides, PhotoFacts, ThermalPhoto
from mrgs.data.radiometric.visible import MAX_PIXELS, Alignment, VisibleImage, opened
from mrgs.scene.radiometry import ObjectParameters, Planck

_IMAGE_OFFSET = 32
"""Raw data and embedded images follow a header of this many bytes."""

_MEDIAN_LIMITS_C = (-150.0, 3000.0)
"""A photo whose middle temperature lies outside of these was not computed with its camera's
constants."""


class CameraFacts(NamedTuple):
    """What a record says of its camera; None where it does not.

    Attributes:
        model: the maker's name of the model.
        serial: the serial number.
        field_of_view_deg: horizontal, of the lens that was on the camera.
        taken: time by the camera's own clock, without a time zone.
    """

    model: str | None = None
    serial: str | None = None
    field_of_view_deg: float | None = None
    taken: datetime | None = None


def camera_facts(records: Records) -> CameraFacts:
    """What a record says of its camera, without its pixels; a damaged one says nothing."""
    content = records.get(CAMERA_INFO) or b""
    order = order_of(content)
    return CameraFacts() if order is None else _camera(RecordFields(content, order))


def read_flir(record: bytes, path: Path, exif: ExifFacts, overrides: Overrides) -> ThermalPhoto:
    """The photo in an FFF record.

    Args:
        exif: of the JPEG file around it; empty for a bare FFF file.
        overrides: replace the parameters in the file.

    Raises:
        SceneError: the record is cut off or damaged, or its constants are missing or absurd.
    """
    records = Records(record, path)
    info = _camera_info(records, path)
    raw = raw_signal(records.require(RAW_DATA, "raw image"), path)
    planck = _planck(info, path)
    parameters = overrides.applied_to(_parameters(info, path))
    if problem := parameters.problem():
        name, sentence = problem
        raise scene_error(path, f"its {name} of {sentence}; give the true one", options=(name,))
    measurement = Measurement(planck, parameters, _transmission(info, parameters, path))
    celsius, valid = object_temperature(raw, measurement)
    if (
        not valid.any()
        or not _MEDIAN_LIMITS_C[0] <= float(np.median(celsius[valid])) <= _MEDIAN_LIMITS_C[1]
    ):
        raise scene_error(
            path,
            "its Planck constants are absurd: they give no plausible temperature; copy it again",
        )
    facts = _facts(info, records, path, exif, measurement)
    doubts = _doubts(celsius, valid, facts)
    facts = facts.adding(warnings=doubts, given=overrides.of_parameters())
    return ThermalPhoto(celsius, None, valid, facts)


def raw_signal(record: bytes, path: Path) -> UInt16[np.ndarray, "h w"]:
    """The detector's counts in the record of the raw image: a PNG, or bare 16-bit numbers.

    Raises:
        SceneError: damaged, cut off, too large, or compressed in a way that is not read.
    """
    order = order_of(record)
    size = None if order is None else RecordFields(record, order).read(2, "HH")
    if order is None or size is None:
        raise scene_error(
            path, "the header of its raw image is damaged; copy the photo from the camera again"
        )
    width, height = int(size[0]), int(size[1])
    content = record[_IMAGE_OFFSET:]
    if width * height == 0 or width * height > MAX_PIXELS:
        raise scene_error(
            path, f"its raw image of {width} x {height} pixels cannot be; copy the photo again"
        )
    if content.startswith(b"\x89PNG"):
        return _from_png(content, width, height, path)
    if content.startswith(b"\xff\xd8\xff"):
        raise scene_error(
            path,
            "its raw image is compressed with JPEG-LS, which is not read; export it from FLIR's "
            "program as CSV",
        )
    if len(content) < 2 * width * height:
        raise cut_off(path, "raw image", len(content), 2 * width * height)
    return (
        np.frombuffer(content, f"{order}u2", width * height)
        .reshape(height, width)
        .astype(np.uint16)
    )


def _from_png(content: bytes, width: int, height: int, path: Path) -> UInt16[np.ndarray, "h w"]:
    with opened(io.BytesIO(content), path, ("PNG",), "its raw image") as image:
        if image.size != (width, height) or not image.mode.startswith("I"):
            raise scene_error(
                path,
                f"its raw image is {image.width} x {image.height} pixels of type {image.mode}, "
                f"where "
                f"{width} x {height} of 16 bits are announced; copy the photo from the camera "
                f"again",
            )
        values = np.array(image).astype(np.uint16)
    swapped = values.byteswap()
    # PNG is big-endian, yet most of these cameras write little-endian: in the wrong order, each
    # step of 1 becomes 256.
    return values if _roughness(values) < _roughness(swapped) else swapped


def _roughness(values: UInt16[np.ndarray, "h w"]) -> int:
    signed = values.astype(np.int64)
    return int(np.abs(np.diff(signed, axis=0)).sum() + np.abs(np.diff(signed, axis=1)).sum())


def _camera_info(records: Records, path: Path) -> RecordFields:
    content = records.require(CAMERA_INFO, "camera info with the Planck constants")
    order = order_of(content)
    if order is None:
        raise scene_error(path, "its camera info is damaged; copy the photo from the camera again")
    return RecordFields(content, order)


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
        raise scene_error(
            path,
            f"its Planck constants are absurd ({problem}); copy the photo from the camera again",
        )
    return planck


def _parameters(info: RecordFields, path: Path) -> ObjectParameters:
    stored = [
        info.number(0x20),
        info.number(0x24),
        info.celsius(0x28),
        info.celsius(0x2C),
        info.number(0x3C),
    ]
    stored += [info.celsius(0x30), info.number(0x34)]
    found = [value for value in stored if value is not None]
    if len(found) < len(stored):
        raise scene_error(path, "its camera info is cut off; copy the photo from the camera again")
    emissivity, distance_m, reflected_c, atmospheric_c, humidity, window_c, window_transmission = (
        found
    )
    if 1 < humidity <= 100:  # some cameras store per cent
        humidity /= 100
    return ObjectParameters(
        emissivity, distance_m, reflected_c, atmospheric_c, humidity, window_c, window_transmission
    )


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


def _facts(
    info: RecordFields, records: Records, path: Path, exif: ExifFacts, measurement: Measurement
) -> PhotoFacts:
    camera = _camera(info)
    visible, warnings = _visible(records, path)
    return PhotoFacts(
        source="FLIR radiometric JPEG" if exif != ExifFacts() else "FLIR thermal record",
        camera=camera.model or exif.model,
        serial=camera.serial,
        taken=exif.taken or camera.taken,
        gps=exif.gps,
        parameters=measurement.parameters,
        planck=measurement.planck,
        calibrated_c=_range(info.celsius(0x94), info.celsius(0x90)),
        scale_c=_scale(info, measurement),
        visible=visible,
        notes=(f"The air lets {100 * measurement.transmission:.1f} % of the radiation pass.",),
        warnings=warnings,
    )


def _camera(info: RecordFields) -> CameraFacts:
    view_deg = info.number(0x1B4)
    return CameraFacts(
        clean_text(info.data[0xD4:0xF4]),
        clean_text(info.data[0x104:0x114]),
        view_deg if view_deg is not None and 0 < view_deg < 180 else None,
        _time(info),
    )


def _range(low: float | None, high: float | None) -> tuple[float, float] | None:
    if low is None or high is None or not -273.15 <= low < high <= 5000:
        return None
    return low, high


def _scale(info: RecordFields, measurement: Measurement) -> tuple[float, float] | None:
    """What is printed at the ends of the colour scale: the camera stores its middle and its width
    in counts."""
    middle, width = info.read(0x338, "H"), info.read(0x33C, "H")
    if middle is None or width is None or width[0] == 0:
        return None
    ends = middle[0] + np.array([-0.5, 0.5]) * width[0]
    low, high = np.round(measurement.celsius(ends), 2).tolist()
    return _range(low, high)


def _time(info: RecordFields) -> datetime | None:
    """The camera's local time, which it stores as if it were UTC."""
    stamp = info.read(0x384, "II")
    if stamp is None or stamp[0] == 0:
        return None
    return datetime(1970, 1, 1) + timedelta(seconds=stamp[0], milliseconds=min(stamp[1], 999))


def _visible(records: Records, path: Path) -> tuple[VisibleImage | None, tuple[str, ...]]:
    content = records.get(EMBEDDED_IMAGE)
    if content is None:
        return None, ()
    image = content[_IMAGE_OFFSET:]
    if not image.startswith((b"\x89PNG", b"\xff\xd8\xff")):
        return None, (
            "The photo in visible light inside the file is of an unknown kind; left out.",
        )
    return VisibleImage(image, path, _alignment(records.get(PICTURE_IN_PICTURE))), ()


def _alignment(record: bytes | None) -> Alignment | None:
    """The record has no mark of its byte order: the one that gives a plausible ratio is taken."""
    for order in ("<", ">"):
        found = None if record is None else RecordFields(record, order).read(0, "f6h")
        if found is not None and 0.1 < found[0] < 10:
            dx, dy, left, right, top, bottom = (int(value) for value in found[1:])
            return Alignment(float(found[0]), dx, dy, (left, right, top, bottom))
    return None


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
