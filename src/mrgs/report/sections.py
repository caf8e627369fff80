"""The contents of the report's sections, for its template."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from PIL import Image

from mrgs.errors import RunError
from mrgs.evaluation.figures import REPORTED
from mrgs.evaluation.report import COLUMNS, heading
from mrgs.marks.emissivity import records_of
from mrgs.marks.tables import value_text
from mrgs.pictures.drawing import Scale, scale_bar
from mrgs.pictures.html import InlineImage, inline_image
from mrgs.pictures.palette import PaletteName
from mrgs.pictures.values import decimals_of, full_scale, in_unit, unit_label
from mrgs.report.pictures import Marked, crops, overview, photo_value, surroundings
from mrgs.report.spots import Renderer, Spot, find_spots
from mrgs.runs.open import Run
from mrgs.scene import (
    THERMAL,
    Modality,
    Scene,
    TemperatureRange,
    View,
    in_order,
)
from mrgs.scene.radiometry import PhotoRecord
from mrgs.survey import Survey

PALETTE: PaletteName = "inferno"
JPEG_QUALITY = 88
SHEET_WIDTH_PX = 1600
SCALE_BAR_PX = 420


class ShownSpot(NamedTuple):
    """A spot as the report shows it; numbers are formatted.

    Attributes:
        name: H1 is the hottest, C1 the coldest.
        value: temperature, without unit.
        contrast: its temperature minus that of its surroundings.
        low: 10th percentile over the views.
        high: 90th percentile over the views.
        views: number of views that see it.
        position: x, y, z in scene units.
        view: name of the view that shows it best.
        pictures: crops of that view's photos and thermal rendering.
        photo: temperature of the thermal photo there; None where it has no valid pixel.
        at_end: whether the value is at an end of the recorded range.
    """

    name: str
    value: str
    contrast: str
    low: str
    high: str
    views: int
    position: str
    view: str
    pictures: list[InlineImage]
    photo: str | None
    at_end: bool


class Spots(NamedTuple):
    """The hottest and the coldest spots, as the report shows them.

    Attributes:
        view: name of the overview's view.
        pictures: the overview, and the scale of its colours.
        spots: the hottest first, then the coldest.
    """

    view: str
    pictures: list[InlineImage]
    spots: list[ShownSpot]


class Scores(NamedTuple):
    """Contents of ``eval/metrics.json``.

    Attributes:
        steps: training steps of the model that was scored.
        rows: name and value of each score.
    """

    steps: int
    rows: list[tuple[str, str]]


def find_named_spots(run: Run, scene: Scene) -> dict[str, Spot]:
    """The hottest spots, H1 first, then the coldest, C1 first; empty if no surface is seen."""
    hottest, coldest = find_spots(_views(scene), _thermal_renderer(run), ball=scene.reach)
    named = {f"H{i}": spot for i, spot in enumerate(hottest, 1)}
    return named | {f"C{i}": spot for i, spot in enumerate(coldest, 1)}


def show_spots(named: Mapping[str, Spot], run: Run, scene: Scene) -> Spots:
    """An overview and crops of at least one spot.

    Args:
        named: spots by their names.
        run: that renders them.
        scene: with the photos.

    Raises:
        SceneError: a photo cannot be read.
    """
    views = _views(scene)
    scale = full_scale(THERMAL, scene.temperature, PALETTE)
    scale = scale._replace(unit=unit_label(THERMAL, scene.temperature))
    marked = overview(views, named, _thermal_renderer(run), scale)
    bar = inline_image(scale_bar(scale, SCALE_BAR_PX, "horizontal"), "temperature scale", png=True)
    shown = [_shown(name, spot, views, run, scale) for name, spot in named.items()]
    return Spots(views[marked.view].name, [*_inline(marked, "the spots marked"), bar], shown)


def _views(scene: Scene) -> list[View]:
    return [*scene.train, *scene.eval]


def _thermal_renderer(run: Run) -> Renderer:
    return lambda camera: run.render({THERMAL: camera})


def capture_rows(scene: Scene, survey: Survey) -> list[tuple[str, str]]:
    """Views, image sizes and temperature range of the capture, and the thermal camera: as the
    photos name it, or else the survey."""
    views = _views(scene)
    modalities = in_order((*REPORTED, *scene.modalities))
    shared = all(
        view.shares_camera(modality, other)
        for view in views
        for modality, other in pairwise(modalities)
    )
    every = "both" if len(modalities) == 2 else "all"
    temperature = scene.temperature
    return [
        ("Views", f"{len(scene.train)} training, {len(scene.eval)} evaluation"),
        *((f"{heading(each)} photos", _sizes(each, views)) for each in modalities),
        ("Cameras", f"one for {every} images" if shared else "each image has its own"),
        (
            "Temperature range",
            "no °C known: relative values"
            if temperature is None
            else f"{temperature.min_c:.4g} °C to {temperature.max_c:.4g} °C",
        ),
        *_record_rows(records_of(scene), survey),
    ]


def _record_rows(records: Sequence[PhotoRecord], survey: Survey) -> list[tuple[str, str]]:
    """What the thermal camera noted: itself, the time, and the settings of the temperatures."""
    known = [record.parameters for record in records if record.parameters is not None]
    cameras = {f"{each.camera} {each.serial}".strip() for each in records} - {""}
    cameras = cameras or {f"{survey.camera or ''} {survey.camera_serial or ''}".strip()} - {""}
    times = sorted(record.taken for record in records if record.taken is not None)
    missing = "not in the scene's files"
    settings = "; ".join(
        f"{label} {_span([getattr(each, name) for each in known])}{unit}"
        for name, label, unit in _SETTINGS
    )
    return [
        ("Thermal camera, serial number", ", ".join(sorted(cameras)) or missing),
        ("Photos taken", f"{times[0]:%Y-%m-%d %H:%M} to {times[-1]:%H:%M}" if times else missing),
        ("Settings of the temperatures", settings if known else missing),
    ]


_SETTINGS = (
    ("emissivity", "emissivity", ""),
    ("reflected_c", "reflected temperature", " °C"),
    ("distance_m", "distance", " m"),
    ("atmospheric_c", "air", " °C"),
    ("humidity", "relative humidity", ""),
)
"""Parameters of a photo, their names and units in the report."""


def _span(values: Sequence[float]) -> str:
    """The values' range, or the one value that all have."""
    if not values:
        return ""
    low, high = f"{min(values):.3g}", f"{max(values):.3g}"
    return low if low == high else f"{low} to {high}"


def training_rows(run: Run) -> list[tuple[str, str]]:
    """Method, steps, size and cost of the training."""
    facts = run.facts
    memory = facts.peak_memory_bytes
    return [
        ("Method", run.config.method),
        ("Preset", run.config.preset),
        ("Steps", f"{facts.step:,} of {run.config.max_steps:,}"),
        ("Gaussians", f"{len(run.model.gaussians):,}"),
        ("Time", f"{facts.train_seconds / 60:.1f} minutes"),
        ("Memory", f"{memory / 2**20:,.0f} MiB" if memory else "not measured"),
    ]


def read_scores(run: Run) -> Scores | None:
    """The mean scores of ``eval/metrics.json``; None if the run has not been scored.

    Raises:
        RunError: the file is not what ``mrgs eval`` writes.
    """
    path = run.folder.path / "eval" / "metrics.json"
    if not path.is_file():
        return None
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        titles = {each.name: heading(each) for each in (*REPORTED, *run.modalities)}
        rows = [
            (
                f"{titles.get(group, group)} {COLUMNS[name][0]}",
                f"{value:.{COLUMNS[name][1]}f}",
            )
            for group, figures in document["mean"].items()
            for name, value in figures.items()
            if value is not None
        ]
        if not isinstance(document["steps"], int):
            raise ValueError("the number of steps is not a whole number")
        return Scores(document["steps"], rows)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RunError(
            f"{path} is not what `mrgs eval` writes ({error}); run `mrgs eval` again"
        ) from error


def read_contact_sheet(run: Run) -> InlineImage | None:
    """The contact sheet of ``eval/``; None if there is none.

    Raises:
        RunError: it cannot be read.
    """
    path = run.folder.path / "eval" / "contact_sheet.png"
    if not path.is_file():
        return None
    try:
        with Image.open(path) as sheet:
            image = sheet.convert("RGB")
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise RunError(f"{path} cannot be read ({error}); run `mrgs eval` again") from error
    image.thumbnail((SHEET_WIDTH_PX, SHEET_WIDTH_PX * 4))
    return inline_image(image, "contact sheet", quality=JPEG_QUALITY)


def _shown(name: str, spot: Spot, views: Sequence[View], run: Run, scale: Scale) -> ShownSpot:
    view = views[spot.view]
    rendering = run.render({THERMAL: view.images[THERMAL].camera})
    marked = crops(view, spot, rendering, scale)
    around = surroundings(view, spot, rendering)
    photo = photo_value(view, spot)
    x, y, z = spot.position
    return ShownSpot(
        name,
        _number(spot.value, run.temperature),
        _difference(spot.value - around, run.temperature),
        _number(spot.low, run.temperature),
        _number(spot.high, run.temperature),
        spot.views,
        f"{x:.3f}, {y:.3f}, {z:.3f}",
        view.name,
        _inline(marked, f"spot {name}"),
        None if photo is None else _number(photo, run.temperature),
        not 0 < spot.value < 1 and run.image_model.thermal_gain is None,
    )


def _inline(marked: Marked, text: str) -> list[InlineImage]:
    return [
        inline_image(picture, text, quality=JPEG_QUALITY) for picture in marked.pictures.values()
    ]


def _sizes(modality: Modality, views: Sequence[View]) -> str:
    """How many photos of a modality there are, and how large they are."""
    cameras = [view.images[modality].camera for view in views if modality in view.images]
    if not cameras:
        return "none"
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    return f"{len(cameras)}, " + ", ".join(f"{width} × {height} pixels" for width, height in sizes)


def _number(value: float, temperature: TemperatureRange | None) -> str:
    """A normalised temperature in °C with one decimal, or unchanged with three."""
    decimals = decimals_of(THERMAL, temperature)
    shown = round(in_unit(THERMAL, value, temperature), decimals) + 0.0  # turns -0.0 into 0.0
    return f"{shown:.{decimals}f}"


def _difference(value: float, temperature: TemperatureRange | None) -> str:
    """A difference of normalised temperatures in K with one decimal and its sign, or unchanged with
    three."""
    shown = value if temperature is None else value * temperature.span_c
    return value_text(shown, temperature, sign=True)
