"""The page of a prepared scene: what was understood of the photos, so that mistakes are seen before
training."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from html import escape
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrgs.data import load_scene
from mrgs.data.lens import Lens
from mrgs.prepare.consistency import Agreement, agreements
from mrgs.prepare.contract import Development, Georeference, LeftOut, Reconstruction, StageReport
from mrgs.prepare.page.cameras import lens_rows, rig_content, world_section
from mrgs.prepare.page.charts import span_of
from mrgs.prepare.page.document import write_document
from mrgs.prepare.page.markup import (
    bullets,
    column_table,
    fact_table,
    paragraph,
    section,
    views_text,
)
from mrgs.prepare.page.measure import measure_section
from mrgs.prepare.page.overlay import thermal_on_rgb
from mrgs.prepare.page.pairs import MOST_SHOWN, pairs_section, thumbnail_width
from mrgs.prepare.page.shots import Shot, shot_of_files, shot_of_view
from mrgs.prepare.page.temperatures import counted, temperatures_section
from mrgs.prepare.page.world import World, orbit_facts, world_of
from mrgs.prepare.rig import RigCalibration
from mrgs.scene import Scene, View
from mrgs.scene.view import spread

PAGE = "prepare.html"


def write_page(
    scene: Path,
    stages: Sequence[StageReport],
    development: Development,
    reconstruction: Reconstruction | None,
    rig: RigCalibration | None,
    georeference: Georeference | None,
    *,
    left_out: Sequence[LeftOut] = (),
) -> Path:
    """Write ``prepare.html`` into the scene's folder; returns its path.

    One file that needs nothing from the network: warnings, stages with their times, cameras and
    points, each view's photo and thermal image and how they lie on each other, temperatures,
    lenses, and what was left out. What it shows of the views is what ``load_scene`` reads, so that
    it is what training will see.

    Args:
        scene: the folder of the scene, written by ``write_scene`` if there are poses.
        stages: what was done, in order.
        development: the images.
        reconstruction: poses in the scene's world; None if there are none. The scene itself may be
            missing still.
        rig: the thermal camera; None if there is none of its own.
        georeference: scale and north; None if nothing is known of them.
        left_out: files that are in no view, to be listed with the views that have no pose.

    Raises:
        SceneError: the scene or an image in it cannot be read.
        RunError: the page cannot be written.
    """
    content = _content(scene, development, reconstruction)
    world = _world(content, development, georeference)
    sections = [
        _summary(content, stages),
        _stages(stages),
        world_section(world),
        pairs_section(
            content.shots, _overlays(content, reconstruction), content.unit, content.total
        ),
        _temperatures(content, development),
        _cameras(content, reconstruction, rig, georeference),
        _measure(scene, development, reconstruction, georeference),
        _left_out(content, development, reconstruction, left_out),
    ]
    title = f"Prepared scene: {scene.resolve().name}"
    subtitle = f"{date.today().isoformat()}. {scene}"
    facts = {"orbit": None if world is None else orbit_facts(world)}
    return write_document(scene / PAGE, title, subtitle, sections, facts)


@dataclass(frozen=True, eq=False)
class _Content:
    """What several sections show.

    Attributes:
        folder: the scene's.
        total: number of developed views.
        scene: as it will be read; None without poses.
        shots: the views that are shown, in small.
        agreements: how each shot's thermal image agrees with the others.
        unit: of the thermal values; empty where they are relative.
    """

    folder: Path
    total: int
    scene: Scene | None
    shots: list[Shot]
    agreements: list[Agreement | None]
    unit: str


def _content(
    scene: Path, development: Development, reconstruction: Reconstruction | None
) -> _Content:
    shown = [development.views[index] for index in spread(len(development.views), MOST_SHOWN)]
    width = thumbnail_width(len(shown))
    written = reconstruction is not None and (scene / "transforms.json").is_file()
    loaded = load_scene(scene, resolution=width) if written else None
    temperature = None if loaded is None else loaded.temperature
    views = {} if loaded is None else _with_status(loaded)
    failed = (
        {item.name: item.reason for item in reconstruction.failed}
        if reconstruction is not None
        else {}
    )
    shots = []
    for view in shown:
        if view.name in views:
            shots.append(shot_of_view(*views[view.name], temperature, width))
        else:
            reason = (
                f"not in the scene: {failed[view.name]}"
                if view.name in failed
                else "in no scene yet"
            )
            shots.append(shot_of_files(scene, view, reason, temperature, width))
    found: list[Agreement | None] = [None] * len(shots)
    if reconstruction is not None and written:
        images = [shot.thermal if shot.registered else None for shot in shots]
        found = agreements(images, [shot.thermal_camera for shot in shots], reconstruction.points)
    known = temperature is not None or any(view.range_c is not None for view in development.views)
    return _Content(scene, len(development.views), loaded, shots, found, "°C" if known else "")


def _with_status(scene: Scene) -> dict[str, tuple[View, str]]:
    """The views by name, and what each is for."""
    views = {view.name: (view, "training") for view in scene.train}
    return views | {view.name: (view, "held out") for view in scene.eval}


def _world(
    content: _Content, development: Development, georeference: Georeference | None
) -> World | None:
    """Cameras in the order of the views, and points."""
    if content.scene is None:
        return None
    views = _with_status(content.scene)
    cameras = {
        view.name: views[view.name][0].cameras[0]
        for view in development.views
        if view.name in views
    }
    held_out = frozenset(view.name for view in content.scene.eval)
    metric = georeference is not None and georeference.metric
    north = georeference is not None and georeference.north
    return world_of(cameras, held_out, content.scene.points, metric, north)


def _overlays(
    content: _Content, reconstruction: Reconstruction | None
) -> dict[str, Float32[np.ndarray, "h w"]]:
    """The thermal images as the photos' cameras would have taken them."""
    if reconstruction is None or content.scene is None:
        return {}
    visible = reconstruction.visible or {}
    found = {
        shot.name: thermal_on_rgb(shot, reconstruction.points, visible.get(shot.name))
        for shot in content.shots
    }
    return {name: image for name, image in found.items() if image is not None}


def _summary(content: _Content, stages: Sequence[StageReport]) -> str:
    """What came of it, what to do next, and every warning."""
    said = (text for stage in stages for text in stage.warnings)
    warnings = list(dict.fromkeys((*said, *_jumps(content))))
    if content.scene is None:
        lead = "There is no scene yet; the stages below say why."
        next_step = ""
    else:
        train, held_out = len(content.scene.train), len(content.scene.eval)
        lead = (
            f"{train + held_out} of {content.total} views are in the scene: {train} to train on, "
            f"{held_out} held out "
            f"to score the model. "
            f"{'' if content.unit else 'Its thermal values are relative: °C are not known. '}"
            "Look through this page; if it shows what you photographed, train:"
        )
        next_step = (
            f'<p class="next"><code>mrgs train '
            f"{escape(shlex.quote(str(content.folder)))}</code></p>"
        )
    found = (
        f"{len(warnings)} thing{'' if len(warnings) == 1 else 's'} to look at first:"
        if warnings
        else ""
    )
    listing = (
        f'<div class="attention">{paragraph(found, "strong")}{bullets(warnings)}</div>'
        if warnings
        else ""
    )
    return f'<section id="summary">{paragraph(lead, "lead")}{next_step}{listing}</section>'


def _stages(stages: Sequence[StageReport]) -> str:
    rows = [(stage.title, " ".join(stage.lines), _time(stage)) for stage in stages]
    return (
        section("stages", "What was done", column_table(["Stage", "Result", "Time"], rows))
        if rows
        else ""
    )


def _time(stage: StageReport) -> str:
    if stage.reused:
        return "from before"
    minutes, seconds = divmod(int(stage.seconds), 60)
    return f"{minutes} min {seconds:02d} s" if minutes else f"{stage.seconds:.1f} s"


def _temperatures(content: _Content, development: Development) -> str:
    spans = [
        span
        for shot in content.shots
        if shot.thermal is not None and (span := span_of(shot.name, shot.thermal))
    ]
    ranges = sum(view.range_c is not None for view in development.views)
    without = len(development.views) - ranges
    facts = [("Photos", f"{ranges} with °C" + (f", {without} without" if without else ""))]
    cameras = counted([view.camera for view in development.views if view.camera is not None])
    if cameras:
        facts.append(
            (
                "Thermal camera",
                ", ".join(f"{name} ({count} photos)" for name, count in cameras.items()),
            )
        )
    if content.scene is not None and content.scene.temperature is not None:
        temperature = content.scene.temperature
        facts.append(("Range of the scene", f"{temperature.min_c:g} to {temperature.max_c:g} °C"))
    notes = counted([note for view in development.views for note in view.notes])
    return temperatures_section(content.shots, spans, content.unit, facts, notes)


def _jumps(content: _Content) -> list[str]:
    """A warning of thermal images that do not agree with the others on what both see."""
    pairs = zip(content.shots, content.agreements, strict=True)
    names = [shot.name for shot, agreement in pairs if agreement is not None and agreement.jumps]
    if not names:
        return []
    return [
        f"In {views_text(names)} the same places are warmer or colder than in the others, as an "
        f"automatic gain or a "
        "changed span makes them. Photograph with a fixed span, or give radiometric files."
    ]


def _cameras(
    content: _Content,
    reconstruction: Reconstruction | None,
    rig: RigCalibration | None,
    georeference: Georeference | None,
) -> str:
    if reconstruction is None:
        return ""
    lenses: dict[str, Lens] = {
        name: reconstruction.lenses[name] for name in reconstruction.viewmats
    }
    what = "RGB lens" if reconstruction.images == "rgb" else "Thermal lens"
    rows = [("Poses", reconstruction.source)]
    if reconstruction.reprojection_px is not None:
        rows.append(("Reprojection error", f"{reconstruction.reprojection_px:.2f} px (mean)"))
    rows.append(("Points", f"{len(reconstruction.points.positions):,}"))
    rows += lens_rows(lenses, what)
    if georeference is not None:
        rows.append(("Scale and north", georeference.text))
        if georeference.residual_m is not None:
            rows.append(
                ("Distance from the GPS positions", f"{georeference.residual_m:.2f} m (median)")
            )
    is_shared = content.scene is not None and reconstruction.images == "rgb" and rig is None
    shared = paragraph("One camera serves both images.", "note") if is_shared else ""
    own = rig_content(rig, georeference) if rig is not None else shared
    return section("cameras", "Lenses", fact_table(rows) + own)


def _measure(
    scene: Path,
    development: Development,
    reconstruction: Reconstruction | None,
    georeference: Georeference | None,
) -> str:
    """The section on a known distance; nothing where no photo has a pose."""
    if reconstruction is None or reconstruction.images != "rgb":
        return ""
    views = [
        view
        for view in development.views
        if view.name in reconstruction.viewmats and view.rgb is not None
    ]
    return measure_section(scene, views, georeference)


def _left_out(
    content: _Content,
    development: Development,
    reconstruction: Reconstruction | None,
    more: Sequence[LeftOut],
) -> str:
    """Every file and view that is not in the scene, once, with the reason."""
    failed = reconstruction.failed if reconstruction is not None else ()
    items = list(
        dict.fromkeys((item.name, item.reason) for item in (*more, *development.left_out, *failed))
    )
    if not items:
        nothing = (
            "Nothing: every photo is in the scene."
            if content.scene is not None
            else "Nothing so far."
        )
        return section("left-out", "Left out", paragraph(nothing))
    return section("left-out", "Left out", column_table(["File or view", "Why"], items))
