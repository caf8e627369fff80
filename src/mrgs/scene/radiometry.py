"""What a thermal camera notes beside a photo: its calibration, and the settings that the photo's
temperatures were computed with."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, astuple, dataclass, field, replace
from datetime import datetime
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from mrgs.system.typed_json import from_json

ZERO_CELSIUS_K = 273.15

_SCENE_C, _MIDDLE_C = (-60.0, 150.0), (-30.0, 100.0)
"""Ranges of 98 % of the pixels of everyday photos, and of their median, °C."""

Value = TypeVar("Value", float, Tensor, np.ndarray)


@dataclass(frozen=True)
class TemperatureRange:
    """The temperatures that the normalised values 0 and 1 stand for.

    Attributes:
        min_c: temperature of the value 0, °C.
        max_c: temperature of the value 1, °C; larger than ``min_c``.
    """

    min_c: float
    max_c: float

    def __post_init__(self) -> None:
        if not -ZERO_CELSIUS_K <= self.min_c < self.max_c < math.inf:
            raise ValueError(f"not a temperature range in °C: {self.min_c} to {self.max_c}")

    @classmethod
    def around(cls, low: float, high: float) -> TemperatureRange:
        """The range of these temperatures, °C, rounded outwards to whole degrees, and at least one
        degree wide. ValueError if they are not temperatures in °C."""
        first = math.floor(low)
        return cls(float(first), float(max(math.ceil(high), first + 1)))

    def __str__(self) -> str:
        return f"{self.min_c:g} to {self.max_c:g} °C".replace("-", "−")

    @property
    def span_c(self) -> float:
        """Width of the range in °C (equally in K)."""
        return self.max_c - self.min_c

    def to_celsius(self, value: Value) -> Value:
        """Normalised value -> °C."""
        return value * self.span_c + self.min_c

    def to_kelvin(self, value: Value) -> Value:
        """Normalised value -> K."""
        return self.to_celsius(value) + ZERO_CELSIUS_K

    def from_celsius(self, celsius: Value) -> Value:
        """°C -> normalised value (outside [0, 1] where the temperature is outside the range)."""
        return (celsius - self.min_c) / self.span_c


def are_everyday(low: float, middle: float, high: float) -> bool:
    """Whether the 1st, 50th and 99th percentile of photos, in °C, are those of everyday scenes: for
    telling units apart."""
    return _SCENE_C[0] <= low <= high <= _SCENE_C[1] and _MIDDLE_C[0] <= middle <= _MIDDLE_C[1]


COLDEST_C, HOTTEST_C = -200.0, 3500.0
"""Range of thermal cameras, °C; pixels outside of it are masked."""


@dataclass(frozen=True)
class ObjectParameters:
    """Parameters of the measurement, as set in the camera.

    Attributes:
        emissivity: of the object's surface, over 0 to 1.
        distance_m: from the camera to the object, m.
        reflected_c: reflected apparent temperature: what the surroundings, mirrored in the surface,
            look like, °C.
        atmospheric_c: temperature of the air between the camera and the object, °C.
        humidity: relative humidity of that air, 0 to 1.
        window_c: temperature of an infrared window or an external lens at the camera, °C.
        window_transmission: of that window, over 0 to 1; 1 without a window.
    """

    emissivity: float
    distance_m: float
    reflected_c: float
    atmospheric_c: float
    humidity: float
    window_c: float = 20.0
    window_transmission: float = 1.0

    def problem(self) -> tuple[str, str] | None:
        """The first parameter that cannot be true, as its name and a sentence; None if all can."""
        for name, (low, high, unit) in PARAMETER_LIMITS.items():
            value = getattr(self, name)
            if name == "window_c" and self.window_transmission == 1:
                continue  # without a window, some cameras leave its temperature unset
            if not low <= value <= high:  # false for NaN too
                return name, f"{value:g} is not between {low:g} and {high:g}{unit}"
        return None


PARAMETER_LIMITS = {
    "emissivity": (0.01, 1.0, ""),
    "distance_m": (0.0, 1e5, " m"),
    "reflected_c": (COLDEST_C, HOTTEST_C, " °C"),
    "atmospheric_c": (-100.0, 200.0, " °C"),
    "humidity": (0.0, 1.0, " (write 50 % as 0.5)"),
    "window_transmission": (0.01, 1.0, ""),
    "window_c": (COLDEST_C, HOTTEST_C, " °C"),
}
"""Smallest and largest value of each parameter, and its unit as written behind a number."""


@dataclass(frozen=True)
class Planck:
    """A camera's calibration: S = r1 / (r2 (exp(b / T) − f)) − o, for a black body of T kelvin."""

    r1: float
    r2: float
    b: float
    f: float
    o: float

    def problem(self) -> str | None:
        """Why these cannot be a camera's constants; None if they can. b is the second radiation
        constant (14,388 µm K) over the effective wavelength: 500 and 20,000 K are 29 and 0.7 µm."""
        if not all(map(math.isfinite, astuple(self))):
            return "not a number"
        if not (self.r1 > 0 and self.r2 > 0):
            return f"R1 = {self.r1:g}, R2 = {self.r2:g}"
        if not 500 <= self.b <= 20_000:
            return f"B = {self.b:g}"
        if not 0 < self.f <= 10:
            return f"F = {self.f:g}"
        return None

    def signal(self, celsius: float) -> float:
        """The signal of a black body, counts; infinite where the law's denominator vanishes."""
        return float(self.signals(np.float64(celsius)))

    def signals(self, celsius: Float64[np.ndarray, "..."] | np.float64) -> Any:
        """The signals of black bodies, counts; as ``signal``."""
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            exponential = np.exp(self.b / (celsius + ZERO_CELSIUS_K))
            return self.r1 / (self.r2 * (exponential - self.f)) - self.o

    def celsius(self, signal: Float64[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
        """The temperature of the black body with this signal, °C; not finite without one."""
        with np.errstate(all="ignore"):
            kelvin = self.b / np.log(self.r1 / (self.r2 * (signal + self.o)) + self.f)
            return np.where(signal + self.o > 0, kelvin - ZERO_CELSIUS_K, np.nan)


TYPICAL_WAVELENGTH_UM = 10.0
"""The middle of what uncooled thermal cameras see, 7.5 to 13 µm."""

TYPICAL_LAW = Planck(1.0, 1.0, 14_387.77 / TYPICAL_WAVELENGTH_UM, 1.0, 0.0)
"""The law where a camera's own constants are not known: black bodies at that wavelength. The mean
of two temperatures from −40 to 80 °C differs by 0.8 K at most from that of the whole band."""

COLDEST_K, LARGEST_EXPONENT = 150.0, 80.0
"""Lowest temperature blended as radiance, K, and largest b / K. Beyond either, radiance is
negligible and float32 cannot represent it."""


@dataclass(frozen=True)
class BandRadiance:
    """What the pixels of thermal cameras average, as a function of the normalised temperature: the
    radiance of black bodies in the camera's band, R = gain / (exp(b / K) − 1) − offset at K kelvin,
    scaled so that 0 and 1 stay what they are. f of ``Planck``, near 1 in cameras' files, would give
    the law a pole.

    Attributes:
        low_k: temperature of the value 0, K.
        span_k: width of the range of temperatures, K.
        b: of the camera's ``Planck``, K.
    """

    low_k: float
    span_k: float
    b: float

    def __post_init__(self) -> None:
        hottest_k, is_law = self.low_k + self.span_k, 500 <= self.b <= 20_000
        if not (is_law and self.low_k >= 0 < self.span_k and self.coldest_k < hottest_k < math.inf):
            raise ValueError("no radiance of a thermal camera")

    @classmethod
    def of(
        cls, temperature: TemperatureRange | None, law: Planck | None = None
    ) -> BandRadiance | None:
        """The radiance of values on a scale, by the calibration of the camera if it is known; None
        without a scale, or for one that is colder than what thermal cameras see."""
        if temperature is not None:
            with suppress(ValueError):
                return cls(temperature.to_kelvin(0.0), temperature.span_c, (law or TYPICAL_LAW).b)
        return None

    def of_value(self, value: Tensor) -> Tensor:
        """Normalised temperature -> radiance; the same for all below ``coldest_k``, which keep its
        slope, and so come back."""
        mapped: Tensor = _Mapped.apply(value, self._of_value)
        return mapped

    def to_value(self, radiance: Tensor) -> Tensor:
        """Radiance -> normalised temperature, of ``coldest_k`` or more."""
        mapped: Tensor = _Mapped.apply(radiance, self._to_value)
        return mapped

    def of_celsius(self, celsius: float) -> float:
        """The radiance of a temperature, °C."""
        return self.gain * self._unscaled(celsius + ZERO_CELSIUS_K) - self.offset

    @property
    def coldest_k(self) -> float:
        """Temperature of the least radiance, K."""
        return max(COLDEST_K, self.b / LARGEST_EXPONENT)

    @property
    def least(self) -> float:
        """The least radiance, with ``offset``."""
        return self.gain * self._unscaled(self.coldest_k)

    @cached_property
    def gain(self) -> float:
        """Makes the radiance of the value 1 one more than that of the value 0."""
        return 1 / (self._unscaled(self.low_k + self.span_k) - self._unscaled(self.low_k))

    @cached_property
    def offset(self) -> float:
        """What is taken off, so that the radiance of the value 0 is 0."""
        return self.gain * self._unscaled(self.low_k)

    def _of_value(self, value: Tensor) -> tuple[Tensor, Tensor]:
        kelvin = (self.span_k * value).add_(self.low_k).clamp_min_(self.coldest_k)
        growth = torch.exp(self.b / kelvin)
        received = self.gain / (growth - 1)
        # span b gain E / (K (E − 1))², with what was computed already.
        slope = growth.mul_(received.square()).mul_(self.span_k * self.b / self.gain)
        return received.sub_(self.offset), slope.div_(kelvin.square_())

    def _to_value(self, radiance: Tensor) -> tuple[Tensor, Tensor]:
        received = (radiance + self.offset).clamp_min_(self.least)
        growth = (self.gain / received).add_(1)
        kelvin = self.b / torch.log(growth)
        slope = kelvin.square().div_(received.square_().mul_(growth))
        slope.mul_(self.gain / (self.span_k * self.b))
        return kelvin.sub_(self.low_k).div_(self.span_k), slope

    def _unscaled(self, kelvin: float) -> float:
        return 1 / math.expm1(self.b / max(kelvin, self.coldest_k))


class _Mapped(torch.autograd.Function):
    """A function of each number that returns its slope too: a fourth of the time that
    differentiating its steps takes."""

    @staticmethod
    def forward(
        ctx: Any, values: Tensor, function: Callable[[Tensor], tuple[Tensor, Tensor]]
    ) -> Tensor:
        mapped, slope = function(values)
        ctx.save_for_backward(slope)
        return mapped

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        return gradient * slope, None


LONGEST_TEXT = 200


@dataclass(frozen=True)
class PhotoRecord:
    """What a thermal camera noted beside a photo, as far as its file says.

    Attributes:
        source: the kind of file, in words.
        camera: maker's name of the model; empty if not known.
        serial: the camera's serial number; empty if not known.
        taken: by the camera's own clock, or else that of the RGB photo beside it, without a time
            zone; None if not known.
        parameters: with which the temperatures were computed; None if not known.
        planck: the camera's calibration; None if not known.
        given: parameters that the user gave in place of what the file says, by name.
        has_numbers: whether the file held finished temperatures as numbers.
    """

    source: str = ""
    camera: str = ""
    serial: str = ""
    taken: datetime | None = None
    parameters: ObjectParameters | None = None
    planck: Planck | None = None
    given: Mapping[str, float] = field(default_factory=dict, hash=False)
    has_numbers: bool = False

    def __post_init__(self) -> None:
        for name in ("source", "camera", "serial"):
            text = getattr(self, name)
            if len(text) > LONGEST_TEXT or not text.isprintable():
                raise ValueError(f"{name} is not a short text")
        for name, value in self.given.items():
            low, high, _ = PARAMETER_LIMITS.get(name, (math.nan, math.nan, ""))
            if not low <= value <= high:
                raise ValueError(f"the given {name[:LONGEST_TEXT]!r} cannot be true")

    def setting(self, name: str) -> float | None:
        """A parameter of the measurement; None if not known."""
        if self.parameters is None:
            return self.given.get(name)
        value: float = getattr(self.parameters, name)
        return value

    @property
    def is_radiometric(self) -> bool:
        """Whether the temperatures come from the camera's signal or are stored as numbers: in
        neither is a picture's span or gain."""
        return self.parameters is not None or self.has_numbers

    def to_json(self) -> dict[str, Any]:
        """The record as plain values; what is not known is left out."""
        values = asdict(self) | {"taken": None if self.taken is None else self.taken.isoformat()}
        return {name: value for name, value in values.items() if value}

    @classmethod
    def from_json(cls, value: Any) -> PhotoRecord:
        """A record from its JSON form; entries of newer versions are ignored. ValueError, one
        sentence, if the value is not a record."""
        record = from_json(cls, value)
        for found in (record.parameters, record.planck):
            if found is not None and (problem := found.problem()):
                raise ValueError(f"it cannot be true ({problem})")
        when = None if record.taken is None else record.taken.replace(tzinfo=None)
        return replace(record, taken=when)


def law_of(records: Iterable[PhotoRecord]) -> Planck | None:
    """The calibration that most photos have; None if none is known."""
    laws = Counter(record.planck for record in records if record.planck is not None)
    return laws.most_common(1)[0][0] if laws else None
