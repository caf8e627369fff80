"""What was measured and what was found in a run, as the report shows it: a table, and of each mark
the thermal rendering and the photo with the mark drawn in, and its place on the plan."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from mrgs.marks import MarkReading, RunMarks, tables
from mrgs.marks.mark import Mark
from mrgs.marks.regions import Regions
from mrgs.marks.uncertainty import COVERAGE
from mrgs.pictures import drawing
from mrgs.pictures.drawing import Scale
from mrgs.pictures.files import to_array
from mrgs.pictures.html import InlineImage, inline_image
from mrgs.pictures.palette import display_range
from mrgs.pictures.values import in_unit
from mrgs.report import overview
from mrgs.report.anomalies import Anomaly, photo_value
from mrgs.report.texts import Texts
from mrgs.runs.open import Run
from mrgs.scene import RGB, THERMAL, Camera, PosedImage, Scene, TemperatureRange, View
from mrgs.scene.preview import to_rgb8
from mrgs.survey import Survey
from mrgs.system.wording import number_text

WIDTH_PX = 640
MARK_SHARE = 0.5
"""Share of a picture's side that a mark takes up at most."""

LEAST_SHARE = 0.4
"""Smallest share of the photo's width in a picture: the surroundings show where a mark is."""

SPANNED_SHARE = 0.6
"""Share of a picture's sides, about the mark, whose temperatures the colours span."""

NAME_PX, BAR_TEXT_PX, SCALE_GAP_PX = 22, 24, 8
CROSS_PX, DOT_PX = 16, 7


def nearest_view(mark: Mark, scene: Scene) -> View | None:
    """The thermal view from nearest to where the mark was drawn that has all of it in its image."""
    points, eye = torch.tensor(mark.points).double(), torch.tensor(mark.eye).double()
    nearest, least = None, math.inf
    for view in scene.views:
        if THERMAL in view.images:
            camera = view.images[THERMAL].camera
            distance = (camera.position - eye).norm().item()
            if distance < least and bool(camera.contains(camera.project(points)[0]).all()):
                nearest, least = view, distance
    return nearest


def mark_pictures(
    reading: MarkReading,
    view: View,
    regions: Regions,
    scene: Scene,
    style: overview.Style = overview.PLAIN,
) -> list[InlineImage]:
    """A view's thermal rendering with its scale, and its photo. SceneError if it cannot be read."""
    mark = reading.mark
    camera = _about(mark, view.images[THERMAL].camera)
    part = _part_about(mark, camera)
    photos = [_photo_about(mark, view.images[RGB])] if RGB in view.images else []
    values = to_array(regions.render(camera)[THERMAL].image[..., 0])
    values = in_unit(THERMAL, values, scene.temperature)
    scale = style.scale(display_range(values[part]), scene.temperature)
    thermal = Image.fromarray(scale.colorize(values))
    for picture, own in ((thermal, camera), *photos):
        _draw(picture, reading, own)
    whole = drawing.above_scale(thermal, scale, BAR_TEXT_PX, SCALE_GAP_PX)
    return [
        inline_image(whole, f"{mark.name}, thermal", quality=90),
        *(inline_image(photo, f"{mark.name}, photo", quality=88) for photo, _ in photos),
    ]


def _box(mark: Mark, camera: Camera) -> list[Tensor]:
    """The first and the last pixel of a mark, and the size of the image: column, row."""
    pixels, _ = camera.project(torch.tensor(mark.points).double())
    size = pixels.new_tensor([camera.width, camera.height])
    return [pixels.min(dim=0).values, pixels.max(dim=0).values, size]


def _about(mark: Mark, camera: Camera) -> Camera:
    """The part of a camera's image about a mark, ``WIDTH_PX`` wide and in the image's proportions;
    never more than the image."""
    low, high, size = _box(mark, camera)
    share = min(max(((high - low) / size).max().item() / MARK_SHARE, LEAST_SHARE), 1.0)
    left, top = (
        min(max(middle - 0.5 * share * whole, 0.0), (1 - share) * whole)
        for middle, whole in zip((0.5 * (low + high)).tolist(), size.tolist(), strict=True)
    )
    zoom = WIDTH_PX / (share * camera.width)
    K = camera.K.clone()
    K[0, 2] -= left
    K[1, 2] -= top
    K[:2] *= zoom
    return Camera(K, camera.viewmat, WIDTH_PX, round(zoom * share * camera.height))


def _part_about(mark: Mark, camera: Camera) -> tuple[slice, slice]:
    """The rows and columns about a mark whose temperatures the colours of its picture span: sky and
    ground in a corner would leave none for a wall."""
    low, high, size = _box(mark, camera)
    margin = torch.clamp(0.5 * (SPANNED_SHARE * size - (high - low)), min=0)
    first, last = (low - margin).clamp(min=0).int(), (high + margin).ceil().int()
    return slice(int(first[1]), int(last[1])), slice(int(first[0]), int(last[0]))


def _photo_about(mark: Mark, photo: PosedImage) -> tuple[Image.Image, Camera]:
    """The part of a photo about a mark, and its camera."""
    wanted = _about(mark, photo.camera)
    whole = Image.fromarray(to_rgb8(photo.load().values))
    zoom = wanted.K[0, 0].item() / photo.camera.K[0, 0].item()
    left, top = (photo.camera.K[:2, 2] - wanted.K[:2, 2] / zoom).tolist()
    right, bottom = left + wanted.width / zoom, top + wanted.height / zoom
    part = whole.transform(
        (wanted.width, wanted.height),
        Image.Transform.EXTENT,
        (left, top, right, bottom),
        Image.Resampling.BICUBIC,
        fillcolor=drawing.PAPER,
    )
    return part, wanted


def _draw(image: Image.Image, reading: MarkReading, camera: Camera) -> None:
    """The mark with its name and extremes over a picture of a camera."""
    mark = reading.mark
    pixels, _ = camera.project(torch.tensor(mark.points).double())
    corners = [(x, y) for x, y in pixels.tolist()]
    x, y = min(corners, key=lambda corner: corner[1])
    if mark.kind == "spot":
        drawing.draw_strokes(image, drawing.cross(x, y, CROSS_PX), overview.STROKE_PX)
    else:
        drawing.draw_outline(image, corners, mark.is_area, overview.STROKE_PX)
        for place, color in ((reading.low_at, drawing.COLDEST), (reading.high_at, drawing.HOTTEST)):
            if place:
                pixel = camera.project(torch.tensor(place).double())[0]
                drawing.draw_dot(image, pixel.tolist(), DOT_PX, color)
    wide = drawing.text_width(mark.name, NAME_PX) + 14
    left = min(max(x + 10, 2), image.width - wide - 2)
    top = min(max(y - NAME_PX - 22, 2), image.height - NAME_PX - 12)
    drawing.draw_plate(image, (left, top, left + wide, top + NAME_PX + 10), mark.name, NAME_PX)


CHART_WIDTH, CHART_HEIGHT, CHART_LEFT = 560, 150, 64

PAUSE_MIN = 2.0
"""Photos farther apart are not joined by a line, minutes."""

SHADING_PX = 320


class ProfileChart(NamedTuple):
    """The values along a line as an SVG path of ``CHART_WIDTH`` × ``CHART_HEIGHT``, with the texts
    of its lowest and highest value and its length."""

    path: str
    low: str
    high: str
    end: str


ShownMark: TypeAlias = dict[str, Any]
"""A mark as the template reads it, see ``show_marks``."""


def show_marks(
    readings: Sequence[MarkReading],
    reference: str,
    regions: Regions,
    scene: Scene,
    survey: Survey,
    places: overview.PlacePictures,
    style: overview.Style = overview.PLAIN,
) -> list[ShownMark]:
    """Measured marks as the template reads them: their ``texts_of_reading``; ``factor``, a dash
    where there is none; ``pictures``, the thermal rendering, then the photo, of ``view``; ``plan``
    and ``chart``. SceneError if a photo cannot be read."""
    found = []
    for reading in readings:
        mark = reading.mark
        view = nearest_view(mark, scene)
        shown = {
            "factor": _factor(reading.low, tables.total_uncertainty(reading), survey),
            "chart": _chart(reading, scene),
            **tables.texts_of_reading(reading, reference, scene.temperature, scene.world),
            "view": "" if view is None else view.name,
            "pictures": [] if view is None else mark_pictures(reading, view, regions, scene, style),
            "plan": inline_image(places.small(mark), f"{mark.name}, plan", quality=85),
        }
        found.append(shown)
    return found


AIR_C = 0.5
"""Standard uncertainty of the air's temperatures where the survey states none."""


def air_uncertainty(survey: Survey) -> float:
    """Half the width of the 95 % interval of the air's temperatures, K."""
    return COVERAGE * (AIR_C if survey.air_uncertainty_c is None else survey.air_uncertainty_c)


def _factor(lowest: float, around: float, survey: Survey) -> str:
    """f_Rsi = (T_si - T_e) / (T_i - T_e) (ISO 13788), which judges the lowest temperature and is
    defined for surfaces inside only; a dash where it would not be from 0 to 1, as of a radiator.
    ``around`` is the mark's ±; its own follows from that and from the air inside, sensitivity
    coefficient f_Rsi, and outside."""
    inside, outside = survey.inside_c, survey.outside_c
    if survey.side != "inside" or inside is None or outside is None or not inside > outside:
        return tables.DASH
    factor = (lowest - outside) / (inside - outside)
    if not 0 <= factor <= 1:  # nor NaN
        return tables.DASH
    if math.isnan(around):
        return f"{factor:.2f}"
    of_air = air_uncertainty(survey)
    of_factor = math.hypot(around, factor * of_air, (1 - factor) * of_air) / (inside - outside)
    return f"{factor:.2f} ± {max(of_factor, 0.01):.2f}"


def _chart(reading: MarkReading, scene: Scene) -> ProfileChart | None:
    """The profile of a line as a curve that is interrupted where there is no surface."""
    profile = reading.profile
    if profile is None or math.isnan(reading.low):
        return None
    ends = reading.low, reading.high
    low, high = (tables.value_text(each, scene.temperature, unit=True) for each in ends)
    path = _curve(profile.distances / profile.distances[-1], profile.values, *ends)
    return ProfileChart(path, low, high, tables.size_text(reading, scene.world))


def _curve(
    along: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"], low: float, high: float
) -> str:
    """The path of a chart: values between two limits over places from 0 to 1; NaN interrupts it."""
    known = np.isfinite(values)
    x = CHART_LEFT + (CHART_WIDTH - CHART_LEFT - 4) * along
    y = 10 + (CHART_HEIGHT - 34) * (high - values) / max(high - low, 1e-6)
    return "".join(
        f"{'L' if number and known[number - 1] else 'M'}{x[number]:.1f} {y[number]:.1f}"
        for number in np.flatnonzero(known)
    )


class CameraEffects(NamedTuple):
    """What was learned of a drifting and shading thermal camera: the photos' offsets over time, the
    shading as a picture, each None where it is not modelled, by how much a reference temperature
    has shifted the run, empty where there is none, and whether the air is modelled."""

    offsets: ProfileChart | None
    shading: InlineImage | None
    shift: str
    has_air: bool


def camera_effects(run: Run, t: Texts) -> CameraEffects | None:
    """The effects that the report shows; None where none is modelled."""
    drift, shading = run.image_model.thermal_drift, run.image_model.thermal_shading
    has_air = run.image_model.air is not None
    if run.temperature is None or (drift is None and shading is None and not has_air):
        return None
    span_c, chart, picture = run.temperature.span_c, None, None

    def kelvin(value: float) -> str:
        return f"{number_text(value, 2, sign=True)} K"

    if drift is not None:
        offsets = span_c * drift.offsets().double().numpy()
        timed = bool(np.isfinite(drift.minutes).all())
        at = drift.minutes if timed else np.arange(float(len(offsets)))
        order = np.argsort(at, kind="stable")
        at, offsets = at[order] - at.min(), offsets[order]
        pauses = np.flatnonzero(np.diff(at) > PAUSE_MIN) + 1 if timed else ()
        low, high = float(offsets.min()), float(offsets.max())
        path = _curve(
            np.insert(at, pauses, np.nan) / max(at[-1], 1e-6), np.insert(offsets, pauses, np.nan),
            low, high,
        )  # fmt: skip
        end = f"{at[-1]:.0f} min" if timed else t("{count} photos", count=len(at))
        chart = ProfileChart(path, kelvin(low), kelvin(high), end)
    if shading is not None:
        values = span_c * shading(SHADING_PX * 3 // 4, SHADING_PX)[..., 0].double().numpy()
        most = max(float(np.abs(values).max()), 0.05)
        scale = Scale("error", -most, most, "K", t.decimal)
        shown = Image.fromarray(scale.colorize(values))
        drawn = drawing.above_scale(shown, scale, 13, SCALE_GAP_PX)
        picture = inline_image(drawn, "shading", png=True)
    constant = span_c * float(run.image_model.constant)
    return CameraEffects(chart, picture, kelvin(constant) if constant else "", has_air)


class Findings(NamedTuple):
    """What was measured and what was found, and where; for ``like`` see ``like_parts``."""

    places: overview.PlacePictures
    marks: Sequence[ShownMark]
    like: Sequence[Mapping[str, Any]]
    proposals: Sequence[Mapping[str, Any]]


def show_findings(
    marks: RunMarks,
    regions: Regions,
    anomalies: Mapping[str, Anomaly],
    scene: Scene,
    survey: Survey,
    t: Texts,
) -> Findings:
    """Measure the marks, and draw them and the anomalies into photos, renderings, plan and map.
    SceneError if a photo cannot be read."""
    known = marks.marks
    readings = marks.meter.measure(known, regions)
    proposed = [anomaly.reading for anomaly in anomalies.values()]
    facts = [_facts(anomaly, marks.run, scene) for anomaly in anomalies.values()]
    named = {reading.mark.name: reading.mark for reading in (*readings, *proposed)}
    limits = None if scene.temperature is None else survey.scale
    style = overview.Style(survey.palette or "inferno", limits, t.decimal)
    places = overview.draw_places(marks.run, scene, named, marks.meter.survey, regions, style)
    shown, candidates = (
        show_marks(each, reference, regions, scene, survey, places, style)
        for each, reference in ((readings, known.reference), (proposed, ""))
    )
    like = like_parts(readings, scene.temperature)
    both = zip(candidates, facts, strict=True)
    return Findings(places, shown, like, [{"mark": mark, **each} for mark, each in both])


AUTOMATIC = ("B", "P")
"""Names, without their numbers, that areas have until they are given others."""


def like_parts(
    readings: Sequence[MarkReading], temperature: TemperatureRange | None
) -> list[dict[str, Any]]:
    """Areas whose names differ in the number at their end alone, such as the modules of a plant or
    the windows of a house: how many, the median of their means, and what the coldest and the
    hottest differ from it by; numbers are formatted."""
    groups: dict[str, list[MarkReading]] = {}
    for reading in readings:
        name = re.sub(r"[\W_]*\d+$", "", reading.mark.name)
        if reading.mark.is_area and name not in ("", *AUTOMATIC) and not math.isnan(reading.mean):
            groups.setdefault(name, []).append(reading)
    found = []
    for name, parts in groups.items():
        if len(parts) < 2:
            continue
        middle = median(part.mean for part in parts)
        parts.sort(key=lambda part: part.mean)
        ends = [
            (part.mark.name, tables.value_text(part.mean - middle, temperature, sign=True))
            for part in (parts[0], parts[-1])
        ]
        row = {"name": name, "count": len(parts), "ends": ends}
        found.append({**row, "median": tables.value_text(middle, temperature)})
    return found


def _facts(anomaly: Anomaly, run: Run, scene: Scene) -> dict[str, Any]:
    """What was found of a proposal, for the template; numbers are formatted. ``low`` and ``high``
    are the 10th and 90th percentile over the views, ``position`` is in scene units, ``photo`` the
    thermal photo's temperature there, None where it has no valid pixel, and ``at_end`` whether that
    is an end of the recorded range."""
    spot, temperature = anomaly.spot, scene.temperature
    photo = photo_value(scene.views[spot.view], spot)
    gained = run.image_model.thermal_gain is not None
    return {
        "contrast": tables.value_text(anomaly.contrast, temperature, sign=True),
        "low": _text(spot.low, temperature),
        "high": _text(spot.high, temperature),
        "views": spot.views,
        "position": ", ".join(number_text(each, 2) for each in spot.position.tolist()),
        "photo": None if photo is None else _text(photo, temperature),
        "at_end": photo is not None and not 0 < photo < 1 and not gained,
    }


def _text(value: float, temperature: TemperatureRange | None) -> str:
    return tables.value_text(in_unit(THERMAL, value, temperature), temperature)
