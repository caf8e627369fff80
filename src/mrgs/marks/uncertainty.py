"""What a temperature's uncertainty is made of (JCGM 100:2008, the GUM): its parts, and their sum.

That of the settings is the law of propagation, as in S. Muniz et al., Opt. Eng. 53(7), 074101
(2014): the temperature is computed again with each setting changed by its uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, field, replace
from statistics import median
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Float32, Float64

from mrgs.data.radiometric.measurement import Atmosphere
from mrgs.marks.emissivity import CaptureSettings, SurfaceSettings
from mrgs.marks.photo_readings import PhotoReadings
from mrgs.marks.regions import Regions
from mrgs.scene import Scene, TemperatureRange
from mrgs.scene.radiometry import ObjectParameters
from mrgs.survey import Survey
from mrgs.system.wording import Message

Values: TypeAlias = Float64[np.ndarray, "..."]

COVERAGE = 2.0
"""Times the standard uncertainty: an interval that contains the truth in 95 of 100 cases."""

EMISSIVITY, REFLECTED_C, DISTANCE_PERCENT = 0.02, 2.0, 10.0
"""Standard uncertainties of settings where the survey states none."""

WITHIN_LIMIT = 0.95
"""Share of a limit of error within which the error is in 95 of 100 cases, since all within the
limit counts as equally likely (GUM 4.3.7, G.1.3). Twice the standard uncertainty would be 1.15
times the limit, more than the error can be."""

USUAL_ACCURACY = 2.0
"""°C, or per cent of the reading, whichever is more: the limit of error in the data sheets of
nearly all uncooled cameras."""

USUAL_AIR = Atmosphere(0.006569, 0.01262, -0.002276, -0.00667, 1.9)
"""The constants that FLIR's cameras store."""


@dataclass(frozen=True)
class Uncertainty:
    """The parts of a temperature's uncertainty, each as half the width of the interval that would
    contain the truth in 95 of 100 cases if there were no other part; K, or normalised without °C.
    NaN where it is not known.

    Attributes:
        photos: what the photos that see the place disagree by.
        model: how far the model is from what the photos show there, and how sharp the place is.
        detail: how narrow a peak the place is, which the photos blur.
        camera: limit of error of the thermal camera.
    """

    photos: float = math.nan
    model: float = math.nan
    detail: float = math.nan
    camera: float = math.nan
    emissivity: float = math.nan
    reflected: float = math.nan
    distance: float = math.nan

    @property
    def known(self) -> dict[str, float]:
        """The parts that are known, by name."""
        return {name: value for name, value in asdict(self).items() if not math.isnan(value)}

    @property
    def total(self) -> float:
        """All known parts together; NaN where no photo looked."""
        return math.nan if math.isnan(self.photos) else math.hypot(*self.known.values())

    @property
    def of_differences(self) -> float:
        """Without the camera's part, which two places of the same photos have in common."""
        return replace(self, camera=math.nan).total


@dataclass(frozen=True)
class Budget:
    """The uncertainties that do not depend on the place, and what follows from them: medians of the
    photos' parameters, standard uncertainties (K for ``reflected_c``), the camera's limit of error
    (K and per cent of °C), each None if not known; and what was assumed, one sentence each."""

    capture: CaptureSettings = field(default_factory=CaptureSettings)
    parameters: ObjectParameters | None = None
    emissivity: float = EMISSIVITY
    reflected_c: float = REFLECTED_C
    distance_percent: float = DISTANCE_PERCENT
    accuracy: tuple[float, float] | None = None
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, scene: Scene | None, survey: Survey) -> Budget:
        """The budget of a scene's photos, with what a survey states."""
        records = [] if scene is None else scene.records
        known = [record.parameters for record in records if record.parameters is not None]
        accuracy, notes = _accuracy(survey, any(record.camera for record in records))
        stated = (
            survey.emissivity_uncertainty,
            survey.reflected_uncertainty_c,
            survey.distance_uncertainty_percent,
        )
        usual = EMISSIVITY, REFLECTED_C, DISTANCE_PERCENT
        emissivity, reflected, distance = (
            b if a is None else a for a, b in zip(stated, usual, strict=True)
        )
        if known and None in stated:
            notes.append(
                Message(
                    "Assumed as standard uncertainties: emissivity ± {emissivity}, reflected "
                    "temperature ± {reflected} K, distance ± {distance} %.",
                    emissivity=f"{emissivity:g}",
                    reflected=f"{reflected:g}",
                    distance=f"{distance:g}",
                )
            )
        medians = [median(values) for values in zip(*map(astuple, known), strict=True)]
        parameters = ObjectParameters(*medians) if known else None
        capture = CaptureSettings.of(scene)
        return cls(capture, parameters, emissivity, reflected, distance, accuracy, tuple(notes))

    def parts(
        self,
        of_photos: Sequence[Float[np.ndarray, "*shape"]],
        celsius: Float64[np.ndarray, "*shape"],
        surface: SurfaceSettings | None = None,
    ) -> list[Float64[np.ndarray, "*shape"]]:
        """All parts of temperatures' uncertainties: those of photos and model, given as the photos
        have the places, as the surface has them; then camera, emissivity, reflected temperature and
        distance. ``surface`` has the settings there, by default those of the photos."""
        surface = surface or self.capture.surface
        camera = np.full(celsius.shape, np.nan)
        if self.accuracy is not None:
            kelvin, percent = self.accuracy
            camera = WITHIN_LIMIT * np.maximum(kelvin, percent / 100 * np.abs(celsius))
        gain = self._gain(celsius, surface)
        settings = [COVERAGE * part for part in self._settings(celsius, surface)]
        return [*(gain * part for part in (*of_photos, camera)), *settings]

    def with_settings(
        self, parts: Uncertainty, celsius: float, surface: SurfaceSettings | None = None
    ) -> Uncertainty:
        """The parts of the photos and the model, as the photos have the place, with those of camera
        and settings; see ``parts``."""
        of_photos = [np.array([each]) for each in (parts.photos, parts.model, parts.detail)]
        found = self.parts(of_photos, np.array([celsius]), surface)
        return Uncertainty(*(float(part[0]) for part in found))

    def together(
        self,
        of_photos: Float[np.ndarray, "*shape"],
        celsius: Float64[np.ndarray, "*shape"],
        surface: SurfaceSettings | None = None,
    ) -> Float64[np.ndarray, "*shape"]:
        """Root of the sum of the squares of all known ``parts``; NaN where the photos' part is, and
        where a surface with these settings cannot have looked so."""
        first, *others = self.parts([of_photos], celsius, surface)
        squares = np.square(first) + sum(np.square(np.nan_to_num(part)) for part in others)
        total: Float64[np.ndarray, "*shape"] = np.sqrt(squares)
        return total

    def _gain(self, celsius: Values, surface: SurfaceSettings) -> Values:
        """Derivative of a surface's temperature by that of the photos."""
        if surface == self.capture.surface:
            return np.ones(celsius.shape)
        ends = [self.capture.corrected(celsius + step, surface) for step in (-0.5, 0.5)]
        return np.abs(ends[1] - ends[0])

    def _settings(self, celsius: Values, surface: SurfaceSettings) -> list[Values]:
        """Standard uncertainties by emissivity, reflected temperature and distance; NaN where
        neither photos nor mark state these."""
        unknown = np.full(celsius.shape, np.nan)
        if self.parameters is None and surface.reflected_c is None:
            return [unknown, unknown, unknown]
        emissivity, reflected_c = surface.emissivity, surface.reflected_c or 0.0
        varied = [
            [replace(surface, emissivity=_share(emissivity + sign * self.emissivity)),
             replace(surface, reflected_c=reflected_c + sign * self.reflected_c)]
            for sign in (-1, 1)
        ]  # fmt: skip
        ends = [[self.capture.corrected(celsius, each) for each in end] for end in varied]
        distance = unknown if self.parameters is None else self._distance(celsius, surface)
        return [*map(_half, *ends), distance]

    def _distance(self, celsius: Values, surface: SurfaceSettings) -> Values:
        """Standard uncertainty by the distance: with another transmission τ of the air, what
        reaches the camera, τ S + (1 − τ) S_air with S what left the surface, stays."""
        assert self.parameters is not None
        given, law = self.parameters, self.capture.law
        tau = _transmission(given, 1.0)
        air = law.signal(given.atmospheric_c) + law.o
        at_surface = self.capture.received(celsius)
        shares = [_transmission(given, 1 + sign * self.distance_percent / 100) for sign in (-1, 1)]
        signals = [(tau * at_surface + (each - tau) * air) / each for each in shares]
        return _half(*(self.capture.celsius_of(each, surface) for each in signals))


def _half(low: Values, high: Values) -> Values:
    return np.abs(high - low) / 2


def _share(value: float) -> float:
    """An emissivity or a transmission within its limits."""
    return min(max(value, 0.01), 1.0)


def _transmission(given: ObjectParameters, times: float) -> float:
    """Share of the radiation that the air lets through at a multiple of the noted distance."""
    tau = USUAL_AIR.transmission(given.distance_m * times, given.atmospheric_c, given.humidity)
    return _share(tau)


def _accuracy(survey: Survey, has_camera: bool) -> tuple[tuple[float, float] | None, list[str]]:
    """Limit of error of the camera, K and per cent, and what of it was assumed."""
    kelvin, percent = survey.camera_accuracy_c, survey.camera_accuracy_percent
    if kelvin is not None:
        return (kelvin, percent or 0.0), []
    if percent is None and not has_camera:
        return None, ["The accuracy of the thermal camera is not known, and not included."]
    # Data sheets state both; by the per cent alone a camera would be exact about 0 °C.
    limit = (USUAL_ACCURACY, USUAL_ACCURACY if percent is None else percent)
    numbers = {"kelvin": f"{limit[0]:g}", "percent": f"{limit[1]:g}"}
    if percent is None:
        return limit, [
            Message(
                "The camera's accuracy is taken as ± {kelvin} °C or {percent} % of the reading, "
                "whichever is more.",
                **numbers,
            )
        ]
    return limit, [
        Message(
            "The camera's accuracy is stated in per cent alone: it is taken as ± {kelvin} °C "
            "or {percent} % of the reading, whichever is more.",
            **numbers,
        )
    ]


class UncertaintyMeter:
    """Estimates how far temperatures may be from the truth, in 95 of 100 cases, by the thermal
    photos and a budget, None without known °C; ``notes`` are assumptions, one sentence each."""

    def __init__(self, readings: PhotoReadings, budget: Budget | None) -> None:
        self.notes = () if budget is None else budget.notes
        self._readings = readings
        self._budget = budget

    @classmethod
    def of(
        cls,
        readings: PhotoReadings,
        scene: Scene,
        temperature: TemperatureRange | None,
        survey: Survey,
    ) -> UncertaintyMeter:
        """The meter of a scene, of whose photos ``readings`` are; the survey states uncertainties
        of camera and settings."""
        return cls(readings, None if temperature is None else Budget.of(scene, survey))

    def of_mark(
        self,
        points: Float32[np.ndarray, "n 3"],
        value: float,
        surface: SurfaceSettings | None = None,
    ) -> Uncertainty:
        """Uncertainty of the mean of a mark with points on its surface; ``value`` is the mean as
        the photos have it, ``surface`` its settings, by default those of the photos. SceneError if
        a photo cannot be read."""
        parts = Uncertainty(*(float(part[0]) for part in self._readings.of_mark(points, value)))
        if self._budget is None or math.isnan(parts.photos):
            return parts
        return self._budget.with_settings(parts, value, surface)

    def of_points(
        self,
        points: Float32[np.ndarray, "n 3"],
        values: Float32[np.ndarray, " n"],
        regions: Regions | None = None,
    ) -> Float32[np.ndarray, " n"]:
        """Total uncertainty of temperatures at points on surfaces, NaN where no photo looked, [N];
        ``values`` are seen there by the cameras of the photos, not corrected for ``regions``.
        SceneError if a photo cannot be read."""
        return self.together(self.of_photos(points), points, values, regions).astype(np.float32)

    def of_photos(self, points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, " n"]:
        """The parts of photos and model alone; see ``of_points``."""
        return self._readings.of_points(points).total.astype(np.float32)

    def together(
        self,
        of_photos: Float[np.ndarray, "*shape"],
        points: Float[np.ndarray, "*shape 3"],
        values: Float[np.ndarray, "*shape"],
        regions: Regions | None = None,
        eye: Float[np.ndarray, "3"] | None = None,
    ) -> Float[np.ndarray, "*shape"]:
        """The result of ``of_photos`` with the parts of camera and settings; see ``of_points``.
        ``eye`` sees the points, if they are pixels of an image."""
        if self._budget is None:
            return of_photos
        celsius = values.astype(np.float64)
        total = self._budget.together(of_photos, celsius)
        for settings, held in () if regions is None else regions.parts(points, eye):
            total[held] = self._budget.together(of_photos[held], celsius[held], settings)
        return total
