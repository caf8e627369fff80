"""The contents of the report's sections, for its template."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from statistics import median
from typing import Any, NamedTuple

from PIL import Image

from mrgs.errors import RunError
from mrgs.evaluation.metrics import REPORTED
from mrgs.evaluation.report import COLUMNS, PART_NAMES, SPREADS
from mrgs.marks.tables import digits
from mrgs.pictures.html import InlineImage, inline_image
from mrgs.pictures.numbers import number_text
from mrgs.pictures.settings import settings_of
from mrgs.pictures.values import capitalised
from mrgs.report.conditions import known_row
from mrgs.report.texts import Texts
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Modality, Scene, View, WorldFrame, in_order
from mrgs.scene.radiometry import PhotoRecord
from mrgs.survey import Survey

JPEG_QUALITY = 88
SHEET_WIDTH_PX = 1600

KNOCK_OUT_DECIMALS = {"thermal_psnr": 2, "rgb_psnr": 2, "truth_mae_c": 3}
"""Figures of a knocked-out model, in the order of the report's columns."""


class Scores(NamedTuple):
    """Contents of ``eval/metrics.json``: name and value of each score, with aligned poses where
    those of the photos are wrong, by ``pose_error_px``; name and standard deviation of what the
    paper's parts add to a Gaussian, and what is knocked out of the model with its scores then, both
    empty for a model without them."""

    steps: int
    rows: list[tuple[str, str]]
    pose_error_px: float | None
    spreads: list[tuple[str, str]]
    knock_outs: list[list[str]]


def capture_rows(scene: Scene, survey: Survey, t: Texts) -> list[tuple[str, str]]:
    """Views, image sizes, temperature range and scale of the capture, and the thermal camera, by
    the photos or else by the survey; translated."""
    views = scene.views
    modalities = in_order((*REPORTED, *scene.modalities))
    shared = all(
        view.shares_camera(modality, other)
        for view in views
        for modality, other in pairwise(modalities)
    )
    recorded, scale = t("no °C known: relative values"), scene.temperature
    if scale is not None:
        low, high = (t.number(number_text(end, 1)) for end in (scale.min_c, scale.max_c))
        recorded = t("{low} to {high}", low=low, high=high) + " °C"
    counts = {"train": len(scene.train), "evaluation": len(scene.eval)}
    return [
        (t("Views"), t("{train} training, {evaluation} evaluation", **counts)),
        *((t(f"{capitalised(each.title)} photos"), _sizes(each, views, t)) for each in modalities),
        (
            t("Cameras"),
            t("one for all images of a view") if shared else t("each image has its own"),
        ),
        (t("Temperature range"), recorded),
        (t("Lengths"), _lengths(scene.world, t)),
        *_record_rows(scene.records, survey, t),
    ]


def _lengths(world: WorldFrame, t: Texts) -> str:
    """The unit of lengths, and how well GPS fits, which may have given it."""
    if not world.metric:
        return t("without a scale, in scene units")
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
    return [
        (t("Thermal camera, serial number"), ", ".join(sorted(cameras)) or missing),
        (t("Photos taken"), taken),
        known_row(settings_of(records), t),
    ]


def training_rows(run: Run, t: Texts) -> list[tuple[str, str]]:
    """Method, steps, size and cost of the training; translated."""
    facts = run.facts
    memory = facts.peak_memory_bytes
    steps = {"step": t.count(facts.step), "steps": t.count(run.config.max_steps)}
    minutes = t.number(f"{facts.train_seconds / 60:.1f}")
    return [
        (t("Run"), run.folder.path.resolve().name),
        (t("Method"), run.config.method),
        (t("Preset"), run.config.preset),
        (t("Steps"), t("{step} of {steps}", **steps)),
        (t("Gaussians"), t.count(len(run.model.gaussians))),
        (t("Duration"), t("{minutes} minutes", minutes=minutes)),
        (t("Memory"), f"{t.count(round(memory / 2**20))} MiB" if memory else t("not measured")),
    ]


def read_scores(run: Run, t: Texts) -> Scores | None:
    """The mean scores of ``eval/metrics.json``; None if the run has not been scored, RunError if
    the file is not what ``mrgs eval`` writes."""
    path = run.folder.path / "eval" / "metrics.json"
    if not path.is_file():
        return None
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
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
        parts = _parts_rows(document.get("parts") or {}, t)
        return Scores(document["steps"], rows, error_px, *parts)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RunError(
            f"{path} is not what `mrgs eval` writes ({error}); run `mrgs eval` again"
        ) from error


def _parts_rows(
    parts: Mapping[str, Any], t: Texts
) -> tuple[list[tuple[str, str]], list[list[str]]]:
    """``spreads`` and ``knock_outs`` of ``Scores``."""
    spreads = [
        (t(name), t.number(f"{parts[key]:.4f}") + unit)
        for key, (name, unit) in SPREADS.items()
        if parts.get(key) is not None
    ]
    knock_outs = [
        [t(PART_NAMES[part])]
        + [
            "–" if figures[name] is None else t.number(f"{figures[name]:.{decimals}f}")
            for name, decimals in KNOCK_OUT_DECIMALS.items()
        ]
        for part, figures in parts.get("knock_out", {}).items()
    ]
    return spreads, knock_outs


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
