"""The report's sections, for its template: survey, conditions, capture, settings and so on."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from datetime import date
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from PIL import Image

from mrgs.data.images import opened
from mrgs.errors import ConfigError, RunError, SceneError
from mrgs.evaluation.metrics import REPORTED
from mrgs.evaluation.report import COLUMNS
from mrgs.marks.tables import digits, pixel_cm_text
from mrgs.pictures.html import InlineImage, inline_image
from mrgs.pictures.settings import Setting, settings_of
from mrgs.pictures.values import capitalised
from mrgs.report.texts import Texts
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Modality, Scene, View, WorldFrame, in_order
from mrgs.scene.radiometry import PhotoRecord
from mrgs.survey import LABELS, Survey
from mrgs.system.disk import read_text
from mrgs.system.wording import number_text


def contents_of(run: Run, scene: Scene, survey: Survey, t: Texts, appendix: bool) -> dict[str, Any]:
    """What the template needs beside the findings, by its names; with scores and contact sheet if
    there is to be an ``appendix``. ConfigError if the survey's logo cannot be read, RunError if
    scores or contact sheet cannot."""
    has_thermal = THERMAL in scene.modalities
    return {
        "run": run,
        "name": scene.name,
        "title": survey.title or "",
        "subtitle": t.date(date.today()),
        "language": t.language,
        "t": t,
        "survey": survey,
        "cover": stated_rows(survey, t, on_cover=True),
        "stated": stated_rows(survey, t),
        "conditions": conditions_of(survey, thermal_pixel_m(scene)),
        "capture": capture_rows(scene, survey, t),
        "has_thermal": has_thermal,
        "temperature": scene.temperature,
        "depends_on_view": has_thermal and run.model.gaussians.depends_on_view(THERMAL),
        "settings": settings_of(scene.records),
        "setting_text": setting_text,
        "notes": [*(t(note) for note in scene.notes), *crop_notes(run, t)],
        "appendix": appendix,
        "contact_sheet": read_contact_sheet(run) if appendix else None,
        "scores": read_scores(run, t) if appendix else None,
        "logo": read_logo(survey, run.folder.path),
    }


LEAST_DIFFERENCE_K = 10.0
LEAST_W_M2 = 600.0
"""Irradiance from which on ΔT of solar modules is meaningful."""

MOST_PIXEL_CM = 3.0
"""Widest pixel on solar modules, cm: a cell then spans about five."""

ONE_DECIMAL = ("°C", "K", "m/s")
"""Units whose values always have a decimal."""


class Condition(NamedTuple):
    """One condition of a standard; texts are English, for ``Texts``. ``stated`` is empty if neither
    survey nor photos have the quantity, ``met`` None if that is to be judged, and ``words`` are the
    inspector's own in place of ``stated``, printed as they are."""

    what: str
    asked: str
    stated: str
    met: bool | None
    words: str = ""


def conditions_of(survey: Survey, pixel_m: float | None = None) -> list[Condition]:
    """The conditions of the survey's standard, as practitioners cite it; none without one.
    ``pixel_m`` is the width of a pixel of the thermal photos on the surfaces; None if not known."""
    if survey.standard is None:
        return []
    if survey.standard == "IEC TS 62446-3":
        pixel = "" if pixel_m is None else f"{pixel_cm_text(pixel_m)} cm"
        met = None if pixel_m is None else _rounded(100 * pixel_m) <= MOST_PIXEL_CM
        return [
            *(_compared(survey, *each) for each in _PLANT),
            Condition("Pixel of the thermal photos", "at most 3 cm", pixel, met),
        ]
    found = None
    if survey.inside_c is not None and survey.outside_c is not None:
        found = _rounded(survey.inside_c - survey.outside_c)
    met = None if found is None else abs(found) >= LEAST_DIFFERENCE_K
    return [
        Condition("Air inside minus outside", "at least 10 K", _in_kelvin(found), met),
        _steady(survey),
        *(_compared(survey, *each) for each in _BUILDING),
        Condition("Precipitation", "dry surfaces", "", None, survey.precipitation or ""),
    ]


_BUILDING = (
    ("wind_m_s", "at most 5 m/s", -math.inf, 5.0),
    ("hours_without_sun", "at least 2 h", 2.0, math.inf),
)
_PLANT = (
    ("irradiance_w_m2", "at least 600 W/m²", LEAST_W_M2, math.inf),
    ("wind_m_s", "at most 7.8 m/s (4 Beaufort)", -math.inf, 7.8),
    ("cloud_eighths", "at most 2 eighths of the sky", -math.inf, 2.0),
)
"""Arguments of ``_compared``."""


def _compared(survey: Survey, name: str, asked: str, low: float, high: float) -> Condition:
    """A field of the survey that must be within limits."""
    (what, unit), found = LABELS[name], getattr(survey, name)
    met = None if found is None else low <= found <= high
    return Condition(what, asked, _given(found, unit), met)


def _steady(survey: Survey) -> Condition:
    """The difference over the 24 hours before, from the warmest and the coldest hour outside."""
    known = (survey.inside_c, survey.outside_low_c, survey.outside_high_c)
    stated, met = "", None
    if None not in known:
        inside, low, high = (float(each) for each in known if each is not None)
        warmer, colder = inside - low, inside - high
        least = min(warmer, colder, key=abs) if warmer * colder > 0 else 0.0
        stated, met = _in_kelvin(least), abs(_rounded(least)) >= LEAST_DIFFERENCE_K
    return Condition("The same, over the 24 hours before", "at least 10 K", stated, met)


def _in_kelvin(difference: float | None) -> str:
    """A computed difference, rounded as it is judged."""
    return "" if difference is None else _given(_rounded(difference), "K")


def _given(value: float | None, unit: str) -> str:
    """A value that was stated, with its unit and all its digits: at least one decimal, but for
    units that are mostly stated whole."""
    if value is None:
        return ""
    text = f"{Decimal(repr(float(value) + 0.0)):f}"  # repr alone may have an exponent
    if unit not in ONE_DECIMAL:
        text = text.removesuffix(".0")
    return f"{text} {unit}".replace("-", "−")


def _rounded(value: float) -> float:
    """The value as it is shown, so that what is judged is what is read; never −0."""
    return round(value, 1) + 0.0


def stated_rows(survey: Survey, t: Texts, on_cover: bool = False) -> list[tuple[str, str]]:
    """Label and value of what the survey states, on the cover or after the results; translated."""
    rows = []
    for name, (label, unit) in LABELS.items():
        value = getattr(survey, name)
        if value is None or (name in COVER) != on_cover:
            continue
        if isinstance(value, float):
            text = t.number(_given(value, unit))
        elif isinstance(value, date):
            text = t.date(value)
        else:
            text = t(str(value)) if name == "side" else str(value)
        rows.append((t(label), text))
    return rows


COVER = ("object", "address", "client", "inspector", "company", "qualification", "purpose", "date")
"""Fields of the survey that the cover has."""

LOGO_PX = 480, 160


def read_logo(survey: Survey, folder: Path) -> InlineImage | None:
    """The survey's logo, by its path from the folder; ConfigError if it cannot be read."""
    if survey.logo is None:
        return None
    try:
        with opened(folder / survey.logo, formats=("PNG", "JPEG")) as picture:
            image = picture.convert("RGBA")
    except SceneError as error:
        raise ConfigError(f"the survey's logo: {error}; give a PNG or JPEG file") from None
    image.thumbnail(LOGO_PX)
    return inline_image(image, survey.company or "logo", png=True)


def crop_notes(run: Run, t: Texts) -> list[str]:
    """Sentences on what has been left out of the model; none for a whole one."""
    if run.crop is None:
        return []
    low, high = (t.numbers(", ".join(f"{x:g}" for x in end)) for end in run.crop[:2])
    box = t("Only a box is shown: x, y, z from {low} to {high}.", low=low, high=high)
    within = "Of this box, only what is within an outline of {count} corners is shown."
    return [box, *(t(within, count=t.count(len(outline))) for outline in run.crop.outlines)]


def _listed(settings: Iterable[Setting], t: Texts) -> str:
    return "; ".join(f"{t(each.label)} {_range(each, t)}" for each in settings)


def setting_text(setting: Setting, t: Texts) -> str:
    """A setting and where it is from, for a sentence."""
    if not setting.value:
        unknown = t("not in the scene's files")
        return f"({unknown})"
    text = _range(setting, t)
    return t("{value} (given by the user)", value=text) if setting.given else text


def _range(setting: Setting, t: Texts) -> str:
    low, high = t.number(setting.low), t.number(setting.high)
    text = t("{low} to {high}", low=low, high=high) if setting.differs else low
    return text + setting.unit


JPEG_QUALITY = 88
SHEET_WIDTH_PX = 1600


class Scores(NamedTuple):
    """Contents of ``eval/metrics.json``: name and value of each score, with aligned poses where
    those of the photos are wrong, by ``pose_error_px``."""

    steps: int
    rows: list[tuple[str, str]]
    pose_error_px: float | None


def capture_rows(scene: Scene, survey: Survey, t: Texts) -> list[tuple[str, str]]:
    """Views, image sizes, temperature range and scale of the capture, and the thermal camera, by
    the photos or else by the survey; translated."""
    views = scene.views
    modalities = in_order((*REPORTED, *scene.modalities))
    cameras = []
    if len(scene.modalities) > 1:
        shared = all(
            view.shares_camera(modality, other)
            for view in views
            for modality, other in pairwise(modalities)
        )
        text = t("one for all images of a view") if shared else t("each image has its own")
        cameras = [(t("Cameras"), text)]
    recorded, scale = t("no °C known: relative values"), scene.temperature
    if scale is not None:
        low, high = (t.number(number_text(end, 1)) for end in (scale.min_c, scale.max_c))
        recorded = t("{low} to {high}", low=low, high=high) + " °C"
    counts = {"train": len(scene.train), "evaluation": len(scene.eval)}
    return [
        (t("Views"), t("{train} training, {evaluation} evaluation", **counts)),
        *((t(f"{capitalised(each.title)} photos"), _sizes(each, views, t)) for each in modalities),
        *cameras,
        (t("Temperature range"), recorded),
        (t("Lengths"), _lengths(scene.world, t)),
        *_record_rows(scene.records, survey, t),
    ]


def _lengths(world: WorldFrame, t: Texts) -> str:
    """The unit of lengths, and how well what may have given it fits: a survey, or GPS."""
    if not world.metric:
        return t("without a scale, in scene units")
    if world.control_m is not None:
        off = t.number(digits(world.control_m, 2))
        return t("in metres; surveyed points and lengths are {residual} m off (RMS)", residual=off)
    if world.residual_m is None:
        return t("in metres")
    return t(
        "in metres; the cameras are {residual} m off their GPS positions (median)",
        residual=t.number(digits(world.residual_m, 2)),
    )


def thermal_pixel_m(scene: Scene) -> float | None:
    """Width of a pixel of the thermal photos on what they show (median), metres; None where lengths
    are not known, or no photo shows a start point."""
    if not scene.world.metric:
        return None
    sizes = []
    for photo in scene.train_photos(THERMAL):
        pixels, depth = photo.camera.project(scene.points.positions.double())
        depth = depth[photo.camera.contains(pixels)]
        if len(depth):
            sizes.append((depth.median() / photo.camera.K[0, 0]).item())
    return median(sizes) if sizes else None


def _record_rows(records: Sequence[PhotoRecord], survey: Survey, t: Texts) -> list[tuple[str, str]]:
    """What the thermal camera noted: itself, the time, and the settings of the temperatures."""
    cameras = {f"{each.camera} {each.serial}".strip() for each in records} - {""}
    cameras = cameras or {f"{survey.camera or ''} {survey.camera_serial or ''}".strip()} - {""}
    times = sorted(record.taken for record in records if record.taken is not None)
    missing = t("not in the scene's files")
    taken = missing
    if times:
        first, last = f"{t.date(times[0])} {times[0]:%H:%M}", f"{times[-1]:%H:%M}"
        taken = t("{low} to {high}", low=first, high=last)
    settings = settings_of(records).values()
    known = _listed((each for each in settings if each.value), t)
    given = _listed((each for each in settings if each.given), t)
    return [
        (t("Thermal camera, serial number"), ", ".join(sorted(cameras)) or missing),
        (t("Photos taken"), taken),
        (t("Settings of the temperatures"), known or missing),
        *([(t("Of these, given by the user"), given)] if given else []),
    ]


def read_scores(run: Run, t: Texts) -> Scores | None:
    """The mean scores of ``eval/metrics.json``; None if the run has not been scored, RunError if
    the file is not what ``mrgs eval`` writes."""
    path = run.folder.path / "eval" / "metrics.json"
    if not path.is_file():
        return None
    try:
        document = json.loads(read_text(path))
        poses = document.get("poses") or {}
        aligned = poses.get("aligned")
        titles = {each.name: capitalised(each.title) for each in (*REPORTED, *run.modalities)}
        rows = [
            (
                f"{t(titles.get(group, group))}, {t(COLUMNS[name][0])}",
                t.number(f"{value:.{COLUMNS[name][1]}f}"),
            )
            for group, figures in (aligned or document["mean"]).items()
            for name, value in figures.items()
            if value is not None and group != "truth"
        ]
        if not isinstance(document["steps"], int):
            raise ValueError("the number of steps is not a whole number")
        error_px = float(poses["error_px"]) if aligned else None
        return Scores(document["steps"], rows, error_px)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RunError(
            f"{path} is not what `mrgs eval` writes ({error}); run `mrgs eval` again"
        ) from error


def read_contact_sheet(run: Run) -> InlineImage | None:
    """The contact sheet of ``eval/``, if there is one; RunError if it cannot be read."""
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


def _sizes(modality: Modality, views: Sequence[View], t: Texts) -> str:
    """How many photos of a modality there are, and how large they are."""
    cameras = [view.images[modality].camera for view in views if modality in view.images]
    if not cameras:
        return t("none")
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    shown = (t("{width} × {height} pixels", width=width, height=height) for width, height in sizes)
    return f"{len(cameras)}, " + ", ".join(shown)
