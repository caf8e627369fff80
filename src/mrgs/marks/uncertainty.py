"""What the uncertainty of temperatures and of differences is made of (JCGM 100:2008, the GUM).

That of the settings is the law of propagation, as in S. Muniz et al., Opt. Eng. 53(7), 074101
(2014): the temperature is computed again with each setting changed by its uncertainty. Temperatures
that have an input quantity in common are correlated by it (GUM 5.2); see
``docs/decisions/060-correlated-errors.md``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from mrgs.marks.emissivity import CaptureSettings, SurfaceSettings
from mrgs.marks.photo_readings import COVERAGE, PhotoReadings
from mrgs.marks.regions import Regions
from mrgs.marks.surface import checked_points
from mrgs.scene import Scene, TemperatureRange
from mrgs.scene.air import USUAL_AIR, usual_parameters
from mrgs.scene.radiometry import ObjectParameters
from mrgs.survey import Survey
from mrgs.system.wording import Message

Values: TypeAlias = Float64[np.ndarray, "..."]

EMISSIVITY, REFLECTED_C, DISTANCE_PERCENT, AIR_C = 0.02, 2.0, 10.0, 2.0
"""Standard uncertainties of settings; that of the air before the camera always, the others where
the survey states none."""

WITHIN_LIMIT = 0.95
"""Share of a limit of error within which the error is in 95 of 100 cases, since all within the
limit counts as equally likely (GUM 4.3.7, G.1.3). Twice the standard uncertainty would be 1.15
times the limit, more than the error can be."""

USUAL_ACCURACY = 2.0
"""°C, or per cent of the reading, whichever is more: the limit of error in the data sheets of
nearly all uncooled cameras."""

EVENNESS = 0.2
"""K: what an uncooled camera reads more or less at one place than at another, though its drift and
its shading are corrected; they change while it is in use."""


class InputQuantity(NamedTuple):
    """The camera, its evenness at a place, or a setting and its value, from which temperatures are
    computed and whose error is not known. Equal ones have the same error."""

    name: str
    value: float = 0.0


@dataclass(frozen=True)
class Uncertainty:
    """The parts of a temperature's uncertainty, each as half the width of the interval that would
    contain the truth in 95 of 100 cases if there were no other part; K, or normalised without °C.
    NaN where it is not known.

    Attributes:
        photos: what the photos that see the place disagree by.
        model: how far the model is from what the photos show there.
        detail: how narrow a peak the place is, which the photos blur.
        shared: the parts by input quantities that other temperatures may have too: sensitivity
            coefficient times half the width of the quantity's interval, with the sign.
    """

    photos: float = math.nan
    model: float = math.nan
    detail: float = math.nan
    shared: Mapping[InputQuantity, float] = field(default_factory=dict, hash=False)

    @property
    def known(self) -> dict[str, float]:
        """The sizes of the parts that are known, by name."""
        parts = {"photos": self.photos, "model": self.model, "detail": self.detail}
        for quantity, part in self.shared.items():
            parts[quantity.name] = math.hypot(parts.get(quantity.name, 0.0), part)
        return {name: part for name, part in parts.items() if not math.isnan(part)}

    @property
    def own(self) -> float:
        """The parts of this place alone together, also the uncertainty of its contrast to what is
        beside it on the same surface; NaN where no photo looked."""
        parts = [part for part in (self.model, self.detail) if not math.isnan(part)]
        return math.hypot(self.photos, *parts)

    @property
    def total(self) -> float:
        """All known parts together; NaN where no photo looked."""
        return math.hypot(self.own, *self.shared.values())

    def of_difference(self, other: Uncertainty) -> float:
        """Uncertainty of the difference to another temperature."""
        shared = shared_difference(self.shared, other.shared)
        return math.hypot(self.own, other.own, *shared.values())


def shared_difference(
    one: Mapping[InputQuantity, float], other: Mapping[InputQuantity, float]
) -> dict[InputQuantity, float]:
    """What input quantities contribute to a temperature minus another: one that both have counts
    once, by how much more it changes the first."""
    return {
        quantity: one.get(quantity, 0.0) - other.get(quantity, 0.0)
        for quantity in dict.fromkeys((*one, *other))
    }


@dataclass(frozen=True)
class Budget:
    """The uncertainties that do not depend on the place, and what follows from them: medians of the
    photos' parameters, standard uncertainties (K for ``reflected_c``), the camera's limit of error
    (K and per cent of °C), each None if not known; its evenness, K, 0 where no real camera is
    known; and what was assumed, one sentence each."""

    capture: CaptureSettings = field(default_factory=CaptureSettings)
    parameters: ObjectParameters | None = None
    emissivity: float = EMISSIVITY
    reflected_c: float = REFLECTED_C
    distance_percent: float = DISTANCE_PERCENT
    accuracy: tuple[float, float] | None = None
    evenness: float = 0.0
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, scene: Scene | None, survey: Survey) -> Budget:
        """The budget of a scene's photos, with what a survey states."""
        records = [] if scene is None else scene.records
        parameters = usual_parameters(records)
        has_camera = bool(survey.camera) or any(record.camera for record in records)
        accuracy, notes = _accuracy(survey, has_camera)
        stated = (
            survey.emissivity_uncertainty,
            survey.reflected_uncertainty_c,
            survey.distance_uncertainty_percent,
        )
        usual = EMISSIVITY, REFLECTED_C, DISTANCE_PERCENT
        emissivity, reflected, distance = (
            b if a is None else a for a, b in zip(stated, usual, strict=True)
        )
        if parameters is not None and None in stated:
            notes.append(
                Message(
                    "Assumed as standard uncertainties: emissivity ± {emissivity}, reflected "
                    "temperature ± {reflected} K, distance ± {distance} %, air ± {air} K.",
                    emissivity=f"{emissivity:g}",
                    reflected=f"{reflected:g}",
                    distance=f"{distance:g}",
                    air=f"{AIR_C:g}",
                )
            )
        capture, evenness = CaptureSettings.of(scene), EVENNESS if has_camera else 0.0
        if evenness:
            text = "The camera's unevenness is taken as ± {kelvin} K (95 %)."
            notes.append(Message(text, kelvin=f"{evenness:g}"))
        settings = capture, parameters, emissivity, reflected, distance
        return cls(*settings, accuracy, evenness, tuple(notes))

    def _gain(self, celsius: Values, surface: SurfaceSettings) -> Values:
        """Derivative of a surface's temperature by that of the photos."""
        if surface == self.capture.surface:
            return np.ones(celsius.shape)
        steps = (-0.5, 0.0, 0.5)
        return _slope(*((step, self.capture.corrected(celsius + step, surface)) for step in steps))

    def contributions(
        self, celsius: Values, surface: SurfaceSettings, place: float = 0.0
    ) -> dict[InputQuantity, Values]:
        """What each input quantity contributes to the uncertainty of a surface's temperatures, see
        ``Uncertainty.shared``; ``celsius`` is what the photos give, ``place`` any number that
        differs from place to place."""
        found, nominal = {}, self.capture.corrected(celsius, surface)
        if self.evenness:
            quantity = InputQuantity("evenness", place)
            found[quantity] = self.evenness * self._gain(celsius, surface)
        if self.accuracy is not None:
            kelvin, percent = self.accuracy
            limit = np.maximum(kelvin, percent / 100 * np.abs(celsius))
            found[InputQuantity("camera")] = WITHIN_LIMIT * limit * self._gain(celsius, surface)
        settings = self._settings(surface)
        stated = {quantity.name: quantity.value for quantity in settings}
        for quantity, uncertainty in settings.items():
            ends = [quantity.value - uncertainty, quantity.value + uncertainty]
            if quantity.name == "emissivity":
                ends = [_share(end) for end in ends]
            low, high = (
                (end, self._temperatures(celsius, {**stated, quantity.name: end})) for end in ends
            )
            sensitivity = _slope(low, (quantity.value, nominal), high)
            found[quantity] = COVERAGE * uncertainty * sensitivity
        return found

    def of_mean(
        self,
        of_photos: Uncertainty,
        celsius: Float64[np.ndarray, " n"],
        surfaces: Iterable[tuple[SurfaceSettings, Bool[np.ndarray, " n"]]] = (),
        place: float = 0.0,
    ) -> Uncertainty:
        """Uncertainty of the mean over points, from its parts by photos and model as the photos
        have the place. ``surfaces`` have settings, and which points are on them; elsewhere those of
        the photos. An input quantity has one error throughout: its contributions are averaged.
        Points that cannot have looked so on their surface do not count."""
        left, count = np.ones(len(celsius), bool), 0
        gain, shared = 0.0, dict[InputQuantity, float]()
        for surface, points in (*surfaces, (self.capture.surface, left)):
            values = celsius[points & np.isfinite(self.capture.corrected(celsius, surface))]
            left &= ~points
            if not values.size:
                continue
            count += values.size
            gain += float(self._gain(values, surface).sum())
            for quantity, part in self.contributions(values, surface, place).items():
                shared[quantity] = shared.get(quantity, 0.0) + float(part.sum())
        gain = gain / count if count else math.nan
        shared = {quantity: part / count for quantity, part in shared.items()}
        own = of_photos.photos, of_photos.model, of_photos.detail
        photos, model, detail = (gain * part for part in own)
        return Uncertainty(photos, model, detail, shared)

    def together(
        self,
        of_photos: Float[np.ndarray, "*shape"],
        celsius: Float64[np.ndarray, "*shape"],
        surface: SurfaceSettings | None = None,
    ) -> Float64[np.ndarray, "*shape"]:
        """Root of the sum of the squares of all known parts, of that of photos and model as the
        photos have the places; NaN where that is, and where a surface with these settings, by
        default those of the photos, cannot have looked so."""
        surface = surface or self.capture.surface
        squares = np.square(self._gain(celsius, surface) * of_photos)
        for part in self.contributions(celsius, surface).values():
            squares += np.square(np.nan_to_num(part))
        total: Float64[np.ndarray, "*shape"] = np.sqrt(squares)
        return total

    def _settings(self, surface: SurfaceSettings) -> dict[InputQuantity, float]:
        """The settings that temperatures are computed with, and their standard uncertainties; empty
        where neither photos nor mark state these."""
        given = self.parameters
        if given is None and surface.reflected_c is None:
            return {}
        settings = {
            InputQuantity("emissivity", surface.emissivity): self.emissivity,
            InputQuantity("reflected", surface.reflected_c or 0.0): self.reflected_c,
        }
        if given is not None:
            uncertainty = self.distance_percent / 100 * given.distance_m
            settings[InputQuantity("distance", given.distance_m)] = uncertainty
            settings[InputQuantity("air", given.atmospheric_c)] = AIR_C
        return settings

    def _temperatures(self, celsius: Values, settings: Mapping[str, float]) -> Values:
        """The temperatures of a surface with these settings, from those that the photos give. What
        reaches the camera, τ S + (1 − τ) S_air with S what left the surface, stays."""
        signal, given, law = self.capture.received(celsius), self.parameters, self.capture.law
        if given is not None:
            other = replace(given, distance_m=settings["distance"], atmospheric_c=settings["air"])
            noted, tau = map(_transmission, (given, other))
            of_air, of_other = (law.signal(each.atmospheric_c) + law.o for each in (given, other))
            signal = (noted * signal + (1 - noted) * of_air - (1 - tau) * of_other) / tau
        surface = SurfaceSettings(settings["emissivity"], settings["reflected"])
        return self.capture.celsius_of(signal, surface)


def _slope(
    low: tuple[float, Values], at: tuple[float, Values], high: tuple[float, Values]
) -> Values:
    """Derivative of temperatures, each beside the number that they follow from; one-sided where
    there is no temperature at one end."""
    ends = []
    for number, temperatures in (low, high):
        missing = np.isnan(temperatures)
        ends.append((np.where(missing, at[0], number), np.where(missing, at[1], temperatures)))
    (start, at_start), (end, at_end) = ends
    slope: Values = (at_end - at_start) / np.maximum(end - start, 1e-12)
    return slope


def _share(value: float) -> float:
    """An emissivity or a transmission within its limits."""
    return min(max(value, 0.01), 1.0)


def _transmission(given: ObjectParameters) -> float:
    """Share of the radiation that the air lets through."""
    return _share(USUAL_AIR.transmission(given.distance_m, given.atmospheric_c, given.humidity))


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
    photos and a ``budget``, None without known °C; ``notes`` are assumptions, one sentence each."""

    def __init__(self, readings: PhotoReadings, budget: Budget | None) -> None:
        self.notes = () if budget is None else budget.notes
        self._readings = readings
        self.budget = budget

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
        places: Float[np.ndarray, "n 3"],
        values: Float64[np.ndarray, " n"],
        regions: Regions | None = None,
    ) -> Uncertainty:
        """Uncertainty of the mean of a mark with places on its surface; ``values`` are as the
        photos have them, not corrected for ``regions``. SceneError if a photo cannot be read."""
        of_photos = self._readings.of_mark(checked_points(places), float(values.mean()))
        photos, model, detail = (float(part[0]) for part in of_photos)
        parts = Uncertainty(photos, model, detail)
        if self.budget is None or math.isnan(parts.photos):
            return parts
        surfaces = () if regions is None else regions.parts(places)
        return self.budget.of_mean(parts, values, surfaces, float(places.mean()))

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
        if self.budget is None:
            return of_photos
        celsius = values.astype(np.float64)
        total = self.budget.together(of_photos, celsius)
        for settings, held in () if regions is None else regions.parts(points, eye):
            total[held] = self.budget.together(of_photos[held], celsius[held], settings)
        return total
