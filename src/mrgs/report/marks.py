"""The marks of a run, for the report: a table, and of each mark the thermal rendering and the photo
with the mark drawn in."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image, ImageDraw

from mrgs.marks import MarkReading
from mrgs.marks.mark import Mark
from mrgs.marks.moisture import temperature_factor
from mrgs.marks.regions import Regions
from mrgs.marks.run_marks import RunMarks
from mrgs.marks.tables import DASH, size_text, total_uncertainty, value_text
from mrgs.marks.texts import PART_NAMES
from mrgs.marks.uncertainty import Uncertainty
from mrgs.pictures.drawing import INK, Scale, draw_text, scale_bar, text_width
from mrgs.pictures.files import to_array, to_picture
from mrgs.pictures.html import InlineImage, inline_image
from mrgs.pictures.palette import display_range
from mrgs.pictures.values import in_unit, unit_label
from mrgs.scene import RGB, THERMAL, Camera, Scene, TemperatureRange, View
from mrgs.survey import Survey

PICTURE_PX = 480
MARK_SHARE = 0.5
"""Share of a picture's side that a mark takes up at most."""

LEAST_SHARE = 0.3
"""Side of a picture as a share of the photo's shorter side, at least: what lies about a mark tells
where it is."""

LABEL_PX = 15
WHITE, BLACK, LOW, HIGH = (255, 255, 255), (0, 0, 0), (70, 150, 255), (255, 70, 60)
CHART_WIDTH, CHART_HEIGHT, CHART_LEFT = 560, 150, 46


class ProfileChart(NamedTuple):
    """The values along a line as a chart of ``CHART_WIDTH`` × ``CHART_HEIGHT``.

    Attributes:
        path: of the curve, in the language of SVG.
        low: smallest value, as text.
        high: largest value, as text.
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
        mean: its temperature.
        around: the uncertainty of the mean; empty if it is not known.
        parts: of the uncertainty, as ``SHOWN_PARTS``; a dash for those not known.
        factor: temperature factor of a surface inside; a dash if the air is not known.
        low: the smallest value.
        high: the largest value.
        difference: to the reference, or to the mark that it is compared with.
        compared_with: name of that mark; empty for none.
        size: length, area or diameter.
        photos: how many see it.
        emissivity: of its surface, with the reflected temperature, where it has its own.
        note: the user's.
        problem: why it has no temperature.
        view: name of the view in the pictures; empty without pictures.
        pictures: the thermal rendering, then the photo.
        chart: of a line; else None.
    """

    name: str
    kind: str
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
    emissivity: str
    note: str
    problem: str
    view: str
    pictures: list[InlineImage]
    chart: ProfileChart | None


class ShownMarks(NamedTuple):
    """The marks of a run.

    Attributes:
        marks: in their order.
        places: the marks themselves.
        assumptions: for surfaces with an emissivity of their own.
        doubts: what was assumed of the uncertainty.
    """

    marks: list[ShownMark]
    places: tuple[Mark, ...] = ()
    assumptions: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


SHOWN_PARTS = tuple(PART_NAMES.values())


def show_marks(marks: RunMarks, scene: Scene, survey: Survey) -> ShownMarks:
    """The marks of a run.

    Args:
        marks: of the run.
        scene: with the photos.
        survey: the air inside and outside, for the temperature factor.

    Raises:
        RunError: ``marks.json`` holds the marks of another model.
        SceneError: a photo cannot be read.
    """
    known = marks.marks
    if not len(known):
        return ShownMarks([])
    regions = marks.meter.regions(known)
    readings = marks.meter.measure(known, regions)
    shown = [_shown(reading, known.reference, regions, scene, survey) for reading in readings]
    doubts = () if marks.meter.uncertainty is None else marks.meter.uncertainty.notes
    return ShownMarks(shown, known.marks, marks.meter.capture.notes if regions else (), doubts)


def _shown(
    reading: MarkReading, reference: str, regions: Regions, scene: Scene, survey: Survey
) -> ShownMark:
    mark, temperature = reading.mark, scene.temperature
    view = _nearest_view(mark, scene)
    return ShownMark(
        mark.name,
        mark.kind,
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
        _settings_text(mark),
        mark.note,
        reading.problem,
        "" if view is None else view.name,
        [] if view is None else _pictures(reading, view, regions, scene),
        _chart(reading, scene),
    )


def _around(value: float, temperature: TemperatureRange | None) -> str:
    return "" if math.isnan(value) else value_text(value, temperature)


def _difference(reading: MarkReading, temperature: TemperatureRange | None) -> str:
    text = value_text(reading.difference, temperature, sign=True)
    around = _around(reading.difference_uncertainty, temperature)
    return f"{text} ± {around}" if around else text


def _factor(mean: float, survey: Survey) -> str:
    """f_Rsi of a surface inside."""
    inside, outside = survey.inside_c, survey.outside_c
    if inside is None or outside is None or not inside > outside or math.isnan(mean):
        return DASH
    return f"{temperature_factor(mean, inside, outside):.2f}"


def _settings_text(mark: Mark) -> str:
    """Emissivity and reflected temperature of a mark's surface; empty without its own."""
    texts = []
    if mark.emissivity is not None:
        texts.append(f"ε {mark.emissivity:g}")
    if mark.reflected_c is not None:
        texts.append(f"T refl. {mark.reflected_c:g} °C".replace("-", "−"))
    return ", ".join(texts)


def _nearest_view(mark: Mark, scene: Scene) -> View | None:
    """The thermal view from nearest to where the mark was drawn that has all of it in its image."""
    points, eye = torch.tensor(mark.points).double(), torch.tensor(mark.eye).double()
    views = [view for view in (*scene.train, *scene.eval) if THERMAL in view.images]
    seen = [
        view
        for view in views
        if bool(view.images[THERMAL].camera.contains(_project(view, points)).all())
    ]
    distance = [(view.images[THERMAL].camera.position - eye).norm().item() for view in seen]
    return seen[int(np.argmin(distance))] if seen else None


def _project(view: View, points: torch.Tensor) -> torch.Tensor:
    return view.images[THERMAL].camera.project(points)[0]


def _pictures(
    reading: MarkReading, view: View, regions: Regions, scene: Scene
) -> list[InlineImage]:
    """The thermal rendering with its scale, and the photo, both about the mark."""
    name = reading.mark.name
    camera = _about(reading.mark, view.images[THERMAL].camera)
    values = to_array(regions.render(camera)[THERMAL].image[..., 0])
    values = in_unit(THERMAL, values, scene.temperature)
    scale = Scale("inferno", *display_range(values), unit_label(THERMAL, scene.temperature))
    thermal = Image.fromarray(scale.colorize(values))
    _draw(thermal, reading, camera)
    bar = scale_bar(scale, PICTURE_PX - 16, "horizontal")
    whole = Image.new("RGB", (PICTURE_PX, PICTURE_PX + bar.height + 8), WHITE)
    whole.paste(thermal, (0, 0))
    whole.paste(bar, (8, PICTURE_PX + 8))
    pictures = [inline_image(whole, f"{name}, thermal", quality=90)]
    if RGB in view.images:
        photo_camera = _about(reading.mark, view.images[RGB].camera)
        photo = _cropped(view, photo_camera)
        _draw(photo, reading, photo_camera)
        pictures.append(inline_image(photo, f"{name}, photo", quality=88))
    return pictures


def _about(mark: Mark, camera: Camera) -> Camera:
    """The square part of a camera's image about a mark, ``PICTURE_PX`` wide."""
    pixels, _ = camera.project(torch.tensor(mark.points).double())
    low, high = pixels.min(dim=0).values, pixels.max(dim=0).values
    side = max(
        (high - low).max().item() / MARK_SHARE, LEAST_SHARE * min(camera.width, camera.height)
    )
    left, top = (
        _shifted(middle - 0.5 * side, side, size)
        for middle, size in zip(
            (0.5 * (low + high)).tolist(), (camera.width, camera.height), strict=True
        )
    )
    zoom = PICTURE_PX / side
    K = camera.K.clone()
    K[0, 2] -= left
    K[1, 2] -= top
    K[:2] *= zoom
    return Camera(K, camera.viewmat, PICTURE_PX, PICTURE_PX)


def _shifted(start: float, side: float, size: int) -> float:
    """Where a stretch begins after it was moved into an image, if that can hold it."""
    return min(max(start, 0.0), size - side) if side <= size else 0.5 * (size - side)


def _cropped(view: View, wanted: Camera) -> Image.Image:
    """The part of a view's photo that another camera at its place shows; white beyond it."""
    photo = view.images[RGB]
    whole = Image.fromarray(to_picture(RGB, photo.load().values, None, "grey"))
    zoom = wanted.K[0, 0].item() / photo.camera.K[0, 0].item()
    left, top = (photo.camera.K[:2, 2] - wanted.K[:2, 2] / zoom).tolist()
    side = PICTURE_PX / zoom
    return whole.transform(
        (PICTURE_PX, PICTURE_PX),
        Image.Transform.EXTENT,
        (left, top, left + side, top + side),
        Image.Resampling.BICUBIC,
        fillcolor=WHITE,
    )


def _draw(image: Image.Image, reading: MarkReading, camera: Camera) -> None:
    """The mark with its name and extremes over a picture of a camera."""
    mark, draw = reading.mark, ImageDraw.Draw(image)
    pixels, _ = camera.project(torch.tensor(mark.points).double())
    corners = [(x, y) for x, y in pixels.tolist()]
    x, y = min(corners, key=lambda corner: corner[1])
    for color, width in ((BLACK, 4), (WHITE, 2)):
        if mark.kind == "spot":
            draw.line([(x - 11, y), (x + 11, y)], fill=color, width=width)
            draw.line([(x, y - 11), (x, y + 11)], fill=color, width=width)
        else:
            path = [*corners, corners[0]] if mark.is_area else corners
            draw.line(path, fill=color, width=width, joint="curve")
    if mark.kind != "spot":
        _dot(draw, reading.low_at, camera, LOW)
        _dot(draw, reading.high_at, camera, HIGH)
    wide = text_width(mark.name, LABEL_PX) + 12
    left = min(max(x + 8, 2), image.width - wide - 2)
    top = min(max(y - LABEL_PX - 16, 2), image.height - LABEL_PX - 10)
    draw.rounded_rectangle((left, top, left + wide, top + LABEL_PX + 8), 4, fill=INK)
    middle = (left + wide / 2, top + (LABEL_PX + 8) / 2)
    draw_text(image, middle, mark.name, LABEL_PX, WHITE, anchor="mm")


def _dot(
    draw: ImageDraw.ImageDraw,
    place: Sequence[float],
    camera: Camera,
    color: tuple[int, int, int],
) -> None:
    if place:
        x, y = camera.project(torch.tensor(place).double())[0].tolist()
        draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill=color, outline=WHITE, width=2)


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
    low, high = (value_text(each, scene.temperature) for each in (reading.low, reading.high))
    return ProfileChart(path, low, high, size_text(reading, scene.world))
