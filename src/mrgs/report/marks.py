"""The marks of a run, for the report: a table, and of each mark the thermal rendering and the photo
with the mark drawn in, and its place on the plan."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import NamedTuple

import numpy as np
from PIL import Image

from mrgs.marks import MarkReading
from mrgs.marks.mark import Mark
from mrgs.marks.regions import Regions
from mrgs.marks.tables import (
    DASH,
    around_text,
    settings_texts,
    size_text,
    total_uncertainty,
    value_text,
)
from mrgs.marks.texts import PART_NAMES
from mrgs.marks.uncertainty import Uncertainty
from mrgs.pictures.html import InlineImage, inline_image
from mrgs.report.mark_pictures import mark_pictures, nearest_view
from mrgs.scene import Scene, TemperatureRange
from mrgs.survey import Survey

CHART_WIDTH, CHART_HEIGHT, CHART_LEFT = 560, 150, 64


class ProfileChart(NamedTuple):
    """The values along a line as a chart of ``CHART_WIDTH`` × ``CHART_HEIGHT``.

    Attributes:
        path: of the curve, in the language of SVG.
        low: smallest value with its unit.
        high: largest value with its unit.
        end: length of the line, as text.
    """

    path: str
    low: str
    high: str
    end: str


class ShownMark(NamedTuple):
    """A mark as the report shows it; numbers are formatted.

    Attributes:
        name: of the mark.
        kind: of the mark.
        severity: as the user states it.
        mean: its temperature.
        around: the uncertainty of the mean; empty if it is not known.
        parts: of the uncertainty, as ``SHOWN_PARTS``; a dash for those not known.
        factor: temperature factor of a surface inside; a dash if the air is not known, or it does
            not lie from 0 to 1.
        low: the smallest value.
        high: the largest value.
        difference: to the reference, or to the mark that it is compared with.
        compared_with: name of that mark; empty for none.
        size: length, area or diameter.
        photos: how many see it.
        settings: emissivity and reflected temperature of its surface; empty for those of the
            photos.
        note: the user's.
        problem: why it has no temperature.
        remarks: what to know of the temperatures.
        view: name of the view in the pictures; empty without pictures.
        pictures: the thermal rendering, then the photo.
        plan: where it is.
        chart: of a line; else None.
    """

    name: str
    kind: str
    severity: str
    mean: str
    around: str
    parts: list[str]
    factor: str
    low: str
    high: str
    difference: str
    compared_with: str
    size: str
    photos: str
    settings: list[str]
    note: str
    problem: str
    remarks: list[str]
    view: str
    pictures: list[InlineImage]
    plan: InlineImage
    chart: ProfileChart | None


SHOWN_PARTS = tuple(PART_NAMES.values())


def known_parts(marks: Sequence[ShownMark]) -> dict[int, str]:
    """The parts of the uncertainty that are known of any mark: index and name."""
    shown = [mark.parts for mark in marks if mark.around]
    return {
        index: name
        for index, name in enumerate(SHOWN_PARTS)
        if any(parts[index] != DASH for parts in shown)
    }


def show_marks(
    readings: Sequence[MarkReading],
    reference: str,
    regions: Regions,
    scene: Scene,
    survey: Survey,
    place: Callable[[Mark], Image.Image],
    decimal: str = ".",
) -> list[ShownMark]:
    """Measured marks.

    Args:
        readings: of the marks.
        reference: name of the mark that all differences refer to; empty for none.
        regions: surfaces with an emissivity of their own.
        scene: with the photos.
        survey: the air inside and outside, for the temperature factor.
        place: draws where a mark is.
        decimal: before the decimals of the numbers beside the colours of a picture.

    Raises:
        SceneError: a photo cannot be read.
    """
    return [
        _shown(reading, reference, regions, scene, survey, place, decimal) for reading in readings
    ]


def _shown(
    reading: MarkReading,
    reference: str,
    regions: Regions,
    scene: Scene,
    survey: Survey,
    place: Callable[[Mark], Image.Image],
    decimal: str,
) -> ShownMark:
    mark, temperature = reading.mark, scene.temperature
    view = nearest_view(mark, scene)
    return ShownMark(
        mark.name,
        mark.kind,
        mark.severity,
        value_text(reading.mean, temperature),
        _around(total_uncertainty(reading), temperature),
        [
            value_text(part, temperature)
            for part in asdict(reading.uncertainty or Uncertainty()).values()
        ],
        _factor(reading.mean, survey),
        value_text(reading.low, temperature),
        value_text(reading.high, temperature),
        _difference(reading, temperature),
        "" if math.isnan(reading.difference) else mark.against or reference,
        size_text(reading, scene.world),
        "–" if reading.photos is None else str(reading.photos),
        settings_texts(reading),
        mark.note,
        reading.problem,
        list(reading.remarks),
        "" if view is None else view.name,
        [] if view is None else mark_pictures(reading, view, regions, scene, decimal),
        inline_image(place(mark), f"{mark.name}, plan", quality=85),
        _chart(reading, scene),
    )


def _around(value: float, temperature: TemperatureRange | None) -> str:
    return "" if math.isnan(value) else around_text(value, temperature)


def _difference(reading: MarkReading, temperature: TemperatureRange | None) -> str:
    text = value_text(reading.difference, temperature, sign=True)
    around = _around(reading.difference_uncertainty, temperature)
    return f"{text} ± {around}" if around else text


def _factor(mean: float, survey: Survey) -> str:
    """f_Rsi = (T_si - T_e) / (T_i - T_e) (ISO 13788), which is defined for surfaces inside only; a
    dash where it would not lie from 0 to 1, as of a radiator."""
    inside, outside = survey.inside_c, survey.outside_c
    if (
        survey.side != "inside"
        or inside is None
        or outside is None
        or not inside > outside
        or math.isnan(mean)
    ):
        return DASH
    factor = (mean - outside) / (inside - outside)
    return f"{factor:.2f}" if 0 <= factor <= 1 else DASH


def _chart(reading: MarkReading, scene: Scene) -> ProfileChart | None:
    """The profile of a line as a curve that is interrupted where there is no surface."""
    profile = reading.profile
    if profile is None or math.isnan(reading.low):
        return None
    known = np.isfinite(profile.values)
    span = max(reading.high - reading.low, 1e-6)
    x = CHART_LEFT + (CHART_WIDTH - CHART_LEFT - 4) * profile.distances / profile.distances[-1]
    y = 10 + (CHART_HEIGHT - 34) * (reading.high - profile.values) / span
    path = "".join(
        f"{'L' if number and known[number - 1] else 'M'}{x[number]:.1f} {y[number]:.1f}"
        for number in np.flatnonzero(known)
    )
    low, high = (
        value_text(each, scene.temperature, unit=True) for each in (reading.low, reading.high)
    )
    return ProfileChart(path, low, high, size_text(reading, scene.world))
