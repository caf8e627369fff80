"""A thermal photo after reading, and the values that a user may override."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from PIL import Image

from mrgs.data.images import as_stored, opened
from mrgs.data.radiometric.exif import GpsPosition
from mrgs.data.radiometric.units import Unit
from mrgs.errors import ConfigError
from mrgs.scene.radiometry import PARAMETER_LIMITS, ObjectParameters, PhotoRecord, Planck


@dataclass(frozen=True)
class Overrides:
    """Values that override those in a file; None keeps the file's.

    The first seven are fields of ``mrgs.scene.radiometry.ObjectParameters``, for files with the
    camera's raw signal. The last two are the meaning of the numbers in files without it.
    ConfigError for a value that cannot be true.

    Attributes:
        unit: ``celsius``, ``kelvin`` or ``fahrenheit``, with a factor if the numbers are multiples,
            and an addend: ``kelvin*100``, ``celsius*40+4000``, ``(celsius+100)*40``.
        bounds_c: the temperatures of black and white, °C, for integers that are shades of grey.
    """

    emissivity: float | None = None
    distance_m: float | None = None
    reflected_c: float | None = None
    atmospheric_c: float | None = None
    humidity: float | None = None
    window_c: float | None = None
    window_transmission: float | None = None
    unit: str | None = None
    bounds_c: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name in self.of_parameters():
            value, (low, high, unit) = getattr(self, name), PARAMETER_LIMITS[name]
            if not low <= value <= high:
                raise ConfigError(
                    f"{name} = {value:g} is not between {low:g} and {high:g}{unit}; correct it",
                    options=(name,),
                )
        if self.unit is not None:
            try:
                Unit.parse(self.unit)
            except ValueError as error:
                raise ConfigError(
                    f"{error}; write celsius, kelvin, or for instance kelvin*100 or "
                    f"(celsius+100)*40",
                    options=("unit",),
                ) from None
        if self.bounds_c is not None and not -273.15 <= self.bounds_c[0] < self.bounds_c[1] < 1e5:
            raise ConfigError(
                f"{self.bounds_c[0]:g} to {self.bounds_c[1]:g} is not a range in °C; give the "
                f"smaller value first",
                options=("bounds_c",),
            )
        if self.unit is not None and self.bounds_c is not None:
            raise ConfigError(
                "a unit and bounds are both given; give one of the two",
                options=("unit", "bounds_c"),
            )

    def of_parameters(self) -> dict[str, float]:
        """The overridden parameters of the measurement, by name."""
        given = {name: getattr(self, name) for name in PARAMETER_LIMITS}
        return {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True, eq=False)
class VisibleImage:
    """A visible photo inside a thermal one: the JPEG or PNG file as the camera wrote it, and the
    file that it is from, for messages."""

    data: bytes
    source: Path

    def pixels(self) -> UInt8[np.ndarray, "h w 3"]:
        """The photo in RGB; in a PNG, cameras store luma and chroma (JPEG's YCbCr) in its channels.
        SceneError if the photo is damaged."""
        with opened(self.source, self.data, ("JPEG", "PNG")) as image:
            if image.format == "PNG" and image.mode == "RGB":
                image = Image.merge("YCbCr", image.split())
            return np.array(as_stored(image).convert("RGB"), dtype=np.uint8)


@dataclass(frozen=True)
class PhotoFacts:
    """Facts in a thermal file besides the temperatures; None where it does not say.

    Attributes:
        source: the kind of file, in words, such as "FLIR radiometric JPEG".
        camera: maker's name of the model.
        taken: time by the camera's own clock, without a time zone.
        field_of_view_deg: horizontal, of the thermal camera's lens.
        parameters: with which the temperatures were computed; None for finished numbers.
        planck: calibration of the camera; None for finished numbers.
        calibrated_c: the temperatures that the camera is calibrated for, °C.
        scale_c: ends of the colour scale beside the picture, °C.
        unit: guessed for the file's numbers, such as ``kelvin*100``; None where it is known.
        visible: a photo in visible light inside the file.
        has_numbers: whether the file holds finished temperatures as numbers.
        given: the overrides that the temperatures were computed with, by name.
        notes: how the file was understood, one sentence each.
        warnings: what the user should know before trusting the numbers, one sentence each.
    """

    source: str
    camera: str | None = None
    serial: str | None = None
    taken: datetime | None = None
    gps: GpsPosition | None = None
    field_of_view_deg: float | None = None
    parameters: ObjectParameters | None = None
    planck: Planck | None = None
    calibrated_c: tuple[float, float] | None = None
    scale_c: tuple[float, float] | None = None
    unit: str | None = None
    visible: VisibleImage | None = None
    has_numbers: bool = False
    given: Mapping[str, float] = field(default_factory=dict, hash=False)
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def record(self) -> PhotoRecord:
        """What a scene keeps of these facts."""
        return PhotoRecord(
            self.source, self.camera or "", self.serial or "", self.taken, self.parameters,
            self.planck, self.given, self.has_numbers,
        )  # fmt: skip

    def adding(
        self, *, notes: Iterable[str] = (), warnings: Iterable[str] = (), **changes: Any
    ) -> PhotoFacts:
        """A copy with other values; ``notes`` and ``warnings`` are appended."""
        return replace(
            self, notes=(*self.notes, *notes), warnings=(*self.warnings, *warnings), **changes
        )


@dataclass(frozen=True, eq=False)
class ThermalPhoto:
    """A thermal photo, with exactly one of ``temperature_c`` and ``relative``.

    Attributes:
        temperature_c: [H, W], °C; NaN where not valid.
        relative: [H, W], 0 to 1, from an image without temperatures: brighter is not always warmer.
        valid: [H, W], False where a pixel has no temperature.
    """

    temperature_c: Float32[np.ndarray, "h w"] | None
    relative: Float32[np.ndarray, "h w"] | None
    valid: Bool[np.ndarray, "h w"]
    facts: PhotoFacts

    def __post_init__(self) -> None:
        if (self.temperature_c is None) == (self.relative is None):
            raise ValueError("a thermal photo holds either temperatures or relative values")
