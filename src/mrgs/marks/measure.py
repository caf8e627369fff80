"""Marks measured on a model's surface: temperatures, profiles, lengths and areas."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float

from mrgs.errors import ConfigError
from mrgs.marks.emissivity import CaptureSettings, SurfaceSettings
from mrgs.marks.mark import MOST_MARKS, Mark, Marks
from mrgs.marks.regions import Regions
from mrgs.marks.resolution import RESOLVED_PX, Resolution
from mrgs.marks.surface import (
    checked_points,
    has_flat_outline,
    line_samples,
    marked_pixels,
    measuring_camera,
    outline_area,
    see,
    thermal_values,
)
from mrgs.marks.uncertainty import Uncertainty, UncertaintyMeter
from mrgs.pictures.values import in_unit
from mrgs.scene import THERMAL, Camera, Scene, TemperatureRange
from mrgs.scene.depth_map import PhotoSurvey, SurfaceRenderer, before_background

NO_SURFACE = "no surface there: draw it on the model"
NO_PHOTO = "no photo looks at it, so its temperature is not known"
NO_THERMAL = "the model has no temperatures"

NARROW_HOT = "The hot place is narrower than three pixels of the photos: it is likely hotter."
NARROW_COLD = "The cold place is narrower than three pixels of the photos: it is likely colder."

SEVERAL_SURFACES = (
    "It lies on surfaces of different emissivity: each part is corrected for its own."
)
NO_PLANE = (
    "Its corners do not lie in one plane: it spans several surfaces, or a bent one, and has no "
    "area."
)
ONE_SURFACE = 0.95
"""Share of a mark from which on it counts as lying on one surface."""

STANDING_OUT_C, STANDING_OUT_SHARE = 1.0, 0.03
"""Smallest difference of a narrow place to what is beside it: K, or a share of the range."""


@dataclass(frozen=True, eq=False)
class Profile:
    """The values along a line, in the unit of the reading, NaN where there is no surface, at
    distances from its first point along its straight pieces, scene units; and the ± of each, as of
    a point, NaN where no photo looked."""

    distances: Float[np.ndarray, " s"]
    values: Float[np.ndarray, " s"]
    uncertainties: Float[np.ndarray, " s"]


@dataclass(frozen=True, eq=False)
class MarkReading:
    """A mark with what was measured there; temperatures in °C, or normalised where the scene has no
    known °C. NaN where there is none.

    Attributes:
        mean: over the spot's disc, the samples of the line, or the pixels of the area.
        high_at: the place of the largest value, [3].
        spread: standard deviation over the mark.
        difference: the mean minus that of the mark it is compared with; NaN without one.
        uncertainty: of the mean; None if the photos are not known.
        difference_uncertainty: of the difference, see ``Uncertainty``; NaN if not known.
        length: of a line, along its straight pieces, scene units; else NaN.
        area: of the flat outline of a box or polygon, scene units squared; else NaN, also where its
            corners do not lie in one plane.
        covered: share of the mark where the model shows a surface.
        photos: how many thermal photos see it, of many at least 4; None if their cameras are not
            known.
        profile: of a line; else None.
        surface: emissivity and reflected temperature that most of it is corrected for: those of the
            area with an emissivity of its own in which it lies; None for those of the photos.
        problem: why there is no temperature, one sentence; empty if there is one.
        remarks: what to know of the temperatures, a sentence each.
    """

    mark: Mark
    mean: float = np.nan
    low: float = np.nan
    high: float = np.nan
    low_at: tuple[float, ...] = ()
    high_at: tuple[float, ...] = ()
    spread: float = np.nan
    difference: float = np.nan
    uncertainty: Uncertainty | None = None
    difference_uncertainty: float = np.nan
    length: float = np.nan
    area: float = np.nan
    covered: float = 0.0
    photos: int | None = None
    profile: Profile | None = None
    surface: SurfaceSettings | None = None
    problem: str = ""
    remarks: tuple[str, ...] = ()


MOST_CACHED = 4 * MOST_MARKS


class MarkMeter:
    """Measures marks in one model, with a survey of what the cameras see of it.

    Each mark is measured only once: a note, a name or another mark change no reading. Surfaces with
    an emissivity of their own may be under any mark: when they change, all are measured again. A
    model that ``changes``, in training, is measured every time, by the views from the marks' eyes.
    """

    def __init__(
        self,
        render: SurfaceRenderer,
        temperature: TemperatureRange | None,
        cameras: Sequence[Camera] = (),
        capture: CaptureSettings | None = None,
        uncertainty: UncertaintyMeter | None = None,
        changes: bool = False,
    ) -> None:
        self.capture = capture or CaptureSettings()
        self.uncertainty = uncertainty
        self.survey = PhotoSurvey(render, cameras)
        self._resolution = Resolution(render, self.survey)
        self.render = render
        self._temperature = temperature
        self._changes = changes
        self._own: list[tuple[str, Mark]] = []
        self._regions: Regions | None = None
        self._cached = lru_cache(MOST_CACHED)(self._measured)

    @classmethod
    def of(
        cls,
        render: SurfaceRenderer,
        temperature: TemperatureRange | None,
        scene: Scene | None,
        uncertainty: UncertaintyMeter | None = None,
        changes: bool = False,
    ) -> MarkMeter:
        """The meter of a scene's model, by its thermal cameras and their settings, and without the
        background; by the model alone where the scene is not there."""
        return cls(
            before_background(render, None if scene is None else scene.reach),
            temperature,
            () if scene is None else scene.survey_cameras(THERMAL),
            CaptureSettings.of(scene),
            uncertainty,
            changes,
        )

    def regions(self, marks: Marks) -> Regions:
        """The parts of the surface with an emissivity of their own; the same object as long as they
        and the model are the same."""
        own = [(mark.name, _surface_of(mark)) for mark in marks.marks if mark.has_settings]
        known, before = self._regions, self._own
        renamed = known is not None and known.problems and own != before  # they have names
        changed = [each for _, each in own] != [each for _, each in before]
        if known is None or renamed or changed or self._changes:
            known = Regions(marks, self.render, self._temperature, self.capture)
            self._regions = known
            self._cached.cache_clear()
        self._own = own  # not before: if that fails, the regions are still to be computed
        return known

    def measure(self, marks: Marks, regions: Regions | None = None) -> list[MarkReading]:
        """All marks in their order, with differences; ``regions`` are those of these marks."""
        if regions is None:
            regions = self.regions(marks)
        readings = [self.read(mark, regions) for mark in marks.marks]
        named = {reading.mark.name: reading for reading in readings}
        return [_with_difference(reading, named, marks.reference) for reading in readings]

    def read(self, mark: Mark, regions: Regions | None = None) -> MarkReading:
        """One mark by itself, in a model with regions; those of this mark alone if None."""
        if regions is None:
            regions = self.regions(Marks((mark,)))
        if not self._changes and mark.name not in regions.problems:
            reading = self._cached(_surface_of(mark), regions, self.uncertainty)
            if not reading.problem:  # which has the mark's name
                return replace(reading, mark=mark)
        return self._measured(mark, regions, self.uncertainty)

    def _measured(
        self, mark: Mark, regions: Regions, uncertainty: UncertaintyMeter | None
    ) -> MarkReading:
        """A mark as it is measured now."""
        problem = regions.problems.get(mark.name)
        try:
            if problem:
                raise ConfigError(problem)
            surface = see(self.render, measuring_camera(mark))
        except ConfigError as error:
            return MarkReading(mark, problem=error.message)
        rows, columns, inside = marked_pixels(surface, mark)
        fields: dict[str, Any] = {}
        if mark.kind == "line":
            distances = line_samples(mark)[1]
            fields["length"] = float(distances[-1])
        seen_there = inside & np.isfinite(surface.depth[rows, columns])
        if not seen_there.any():
            return MarkReading(mark, **fields, problem=NO_SURFACE)
        if mark.is_area:
            fields |= (
                {"area": outline_area(mark.points)}
                if has_flat_outline(mark)
                else {"remarks": (NO_PLANE,)}
            )
        reading = MarkReading(mark, **fields, covered=float(seen_there.mean()))
        places = surface.positions[rows[seen_there], columns[seen_there]]
        reading = replace(reading, photos=self._photos_of(places))
        if THERMAL not in surface.rendering:
            return replace(reading, problem=NO_THERMAL)
        if reading.photos == 0:
            return replace(reading, problem=NO_PHOTO)
        shown = thermal_values(surface.rendering)[rows, columns][seen_there]
        values, in_photos = self.temperatures(places, shown, regions, np.array(mark.eye))
        if mark.kind == "line":
            along, around = np.full((2, len(distances)), np.nan)
            along[seen_there] = values
            if uncertainty is not None:
                points = places.astype(np.float32), in_photos.astype(np.float32)
                around[seen_there] = uncertainty.of_points(*points, regions)
            reading = replace(reading, profile=Profile(distances, along, around))
        reading = _with_values(reading, values, places)
        settings, share = regions.shares_at(places)[0]
        remarks = () if share >= ONE_SURFACE else (SEVERAL_SURFACES,)
        reading = replace(reading, surface=settings, remarks=(*reading.remarks, *remarks))
        if uncertainty is None:
            return reading
        found = uncertainty.of_mark(places, in_photos, regions)
        unresolved = self._remarks(reading, found)
        return replace(reading, uncertainty=found, remarks=(*reading.remarks, *unresolved))

    def temperatures(
        self,
        places: Float[np.ndarray, "n 3"],
        shown: Float[np.ndarray, " n"],
        regions: Regions,
        eye: Float[np.ndarray, "3"],
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Temperatures of places that an eye sees, corrected for regions, and as the photos'
        cameras see them in the model, in their unit; ``shown``, normalised, where none does.

        A model's image depends on where its camera points, as Gaussians are projected to first
        order: the model was not fitted to an image of a camera that is turned towards a place."""
        in_photos = shown
        if self.survey.cameras and not self._changes:
            seen = self.survey.temperatures(places.astype(np.float32))
            in_photos = np.where(np.isnan(seen), shown, seen)
        corrected = regions.corrected_at(places, in_photos, self._temperature, eye)
        unit = self._temperature
        return in_unit(THERMAL, corrected, unit), in_unit(THERMAL, in_photos, unit)

    def _remarks(self, reading: MarkReading, uncertainty: Uncertainty) -> tuple[str, ...]:
        """Which of its extremes the photos do not resolve."""
        doubt = replace(uncertainty, detail=math.nan).own
        if self._temperature is None:
            least = max(doubt, STANDING_OUT_SHARE)
        else:
            least = max(doubt, STANDING_OUT_C) / self._temperature.span_c
        mark, extremes = reading.mark, [(reading.high_at, 1), (reading.low_at, -1)]
        if mark.kind == "spot":
            # What is extreme at its edge belongs to what is beside it. Its middle is hot or cold
            # against its surroundings: a cut in something hot is not a cold place.
            extremes = [(mark.points[0], self._resolution.side_of(mark.points[0]))]
        return tuple(
            NARROW_HOT if sign > 0 else NARROW_COLD
            for place, sign in extremes
            if self._resolution.width_px(place, sign, least) < RESOLVED_PX
        )

    def _photos_of(self, places: Float[np.ndarray, "n 3"]) -> int | None:
        """Number of surveyed thermal cameras that see half of the places; None if not known."""
        if not self.survey.cameras:
            return None
        points = checked_points(places)
        shown = [len(item.shown(points).rows) for _, item in self.survey.near(points)]
        return sum(count >= 0.5 * len(points) for count in shown)


def _surface_of(mark: Mark) -> Mark:
    """The mark without what does not change its temperature."""
    return replace(mark, name="-", note="", severity="", against="")


def _with_values(
    reading: MarkReading, values: Float[np.ndarray, " n"], places: Float[np.ndarray, "n 3"]
) -> MarkReading:
    """A reading with the statistics of the values at places."""
    lowest, highest = int(values.argmin()), int(values.argmax())
    return replace(
        reading,
        mean=float(values.mean()),
        low=float(values[lowest]),
        high=float(values[highest]),
        low_at=tuple(places[lowest].tolist()),
        high_at=tuple(places[highest].tolist()),
        spread=float(values.std()),
    )


def _with_difference(
    reading: MarkReading, named: dict[str, MarkReading], reference: str
) -> MarkReading:
    """The reading with ΔT to the mark that it is compared with, if there is one."""
    other = reading.mark.against or reference
    if not other or other == reading.mark.name:
        return reading
    pair = reading, named[other]
    found = [each.uncertainty for each in pair if each.uncertainty is not None]
    return replace(
        reading,
        difference=pair[0].mean - pair[1].mean,
        difference_uncertainty=found[0].of_difference(found[1]) if len(found) == 2 else np.nan,
    )
