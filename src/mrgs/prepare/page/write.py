"""The page of a prepared scene, which shows mistakes before training."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from mrgs.check.agreement import Agreement, agreements, jump
from mrgs.data import load_scene
from mrgs.data.transforms import TRANSFORMS
from mrgs.pictures.html import PAGE_STYLE, script_json, write_html
from mrgs.pictures.page_data import BASE64_SCRIPT
from mrgs.pictures.values import capitalised
from mrgs.prepare.contract import (
    ConvertedPhotos,
    Georeference,
    Reconstruction,
    Skipped,
    StageReport,
)
from mrgs.prepare.page.cameras import lens_rows, rig_facts
from mrgs.prepare.page.pairs import MOST_SHOWN, pairs, thermal_overlay, thumbnail_width
from mrgs.prepare.page.previews import (
    MeasuredPhoto,
    Preview,
    measured_photos,
    preview_of_files,
    preview_of_view,
)
from mrgs.prepare.page.temperatures import Temperatures, setting_rows, temperatures
from mrgs.prepare.page.world import World, orbit_facts
from mrgs.prepare.work import Work
from mrgs.scene import RGB, THERMAL, Scene, View
from mrgs.scene.view import evenly_spaced

PAGE = "prepare.html"
SCRIPTS = (
    BASE64_SCRIPT,
    "pictures/web/navigation.js",
    "pictures/web/numbers.js",
    "prepare/page/orbit.js",
    "prepare/page/pairs.js",
    "prepare/page/measure.js",
    "prepare/page/page.js",
)


def write_page(
    work: Work, without_pose: Sequence[Skipped] = (), most_shown: int = MOST_SHOWN
) -> Path:
    """Write ``prepare.html`` into the scene's folder; returns its path.

    One file that needs nothing from the network: warnings, stages with their times, cameras and
    points, each view's photo and thermal image and their overlay, temperatures, lenses, and what
    was skipped. Its views are those that ``load_scene`` reads, as training will read them.

    Args:
        work: a scene in preparation; results that are not there yet are left out. If there are
            poses, but no scene files, the views are shown without them.
        without_pose: views to be listed with the skipped ones.

    Raises:
        SceneError: the scene or an image in it cannot be read.
        RunError: the page cannot be written.
    """
    content = _content(work, most_shown)
    world = _world(content, work)
    posed = content.posed
    work.found_by_page = _disagreements(content, work)
    warnings = [text for stage in work.reports for text in stage.warnings]
    return write_scene_page(
        work.scene / PAGE,
        "prepare/page/prepare.html",
        f"Prepared scene: {work.scene.resolve().name}",
        world,
        views=content.counts,
        has_celsius=bool(content.unit),
        folder=shlex.quote(str(work.scene)),
        trains=work.trains,
        warnings=list(dict.fromkeys((*warnings, *work.found_by_page))),
        stages=[(stage.title, " ".join(stage.lines), _time(stage)) for stage in work.reports],
        pairs=pairs(content.previews, _overlays(content, work), content.unit, content.total),
        temperatures=_temperatures(content, work.images),
        lenses=_lenses(posed, work.georeference),
        rig=None if work.rig is None else rig_facts(work.rig, work.georeference),
        one_camera=content.scene is not None and posed is not None and posed.images != THERMAL,
        photos=_measured(work, posed),
        metric=work.metric,
        skipped=list(
            dict.fromkeys((item.name, item.reason) for item in (*work.skipped, *without_pose))
        ),
    )


def write_scene_page(
    path: Path, template: str, title: str, world: World | None, **values: Any
) -> Path:
    """Write a page that shows a scene; returns its path.

    Args:
        path: ends with .html, in the scene's folder.
        template: extends ``scene.html``.
        world: cameras and points; None if there are none.

    Raises:
        RunError: the file cannot be written.
    """
    return write_html(
        path,
        template,
        title=title,
        subtitle=f"{date.today().isoformat()}. {path.parent}",
        styles=[PAGE_STYLE, "prepare/page/scene.css"],
        scripts=list(SCRIPTS),
        facts=script_json({"orbit": None if world is None else orbit_facts(world)}),
        world=world,
        **values,
    )


@dataclass(frozen=True, eq=False)
class _Content:
    """Content that several sections share.

    Attributes:
        total: number of converted views.
        posed: poses in the scene's world; None if there are none.
        scene: as it will be read; None without poses.
        previews: the views that are shown.
        agreements: how each preview's thermal image agrees with the others.
        unit: of the thermal values; empty where they are relative.
    """

    total: int
    posed: Reconstruction | None
    scene: Scene | None
    previews: list[Preview]
    agreements: list[Agreement | None]
    unit: str

    @property
    def counts(self) -> Mapping[str, int] | None:
        """Numbers of views for the template; None without poses."""
        if self.scene is None:
            return None
        training, held_out = len(self.scene.train), len(self.scene.eval)
        return {"training": training, "held_out": held_out, "total": self.total}


def _content(work: Work, most_shown: int) -> _Content:
    scene, photos = work.scene, work.images
    posed = None if work.poses is None else work.posed
    shown = [photos.views[index] for index in evenly_spaced(len(photos.views), most_shown)]
    width = thumbnail_width(len(shown))
    written = posed is not None and (scene / TRANSFORMS).is_file()
    loaded = load_scene(scene, resolution=width) if written else None
    temperature = None if loaded is None else loaded.temperature
    views = {} if loaded is None else _with_status(loaded)
    failed = {} if posed is None else {item.name: item.reason for item in posed.failed}
    previews = []
    for done, view in enumerate(shown):
        work.progress("reading images", done, len(shown))
        if view.name in views:
            previews.append(preview_of_view(*views[view.name], temperature, width))
        else:
            reason = (
                f"not in the scene: {failed[view.name]}"
                if view.name in failed
                else "in no scene yet"
            )
            previews.append(preview_of_files(scene, view, reason, temperature, width))
    found: list[Agreement | None] = [None] * len(previews)
    if posed is not None and written:
        images = [view.images.get(THERMAL) if view.registered else None for view in previews]
        found = agreements(
            [None if image is None else image.pixels for image in images],
            [None if image is None else image.camera for image in images],
            posed.points,
        )
    known = temperature is not None or any(view.range_c is not None for view in photos.views)
    unit = "°C" if known else ""
    return _Content(len(photos.views), posed, loaded, previews, found, unit)


def _with_status(scene: Scene) -> dict[str, tuple[View, str]]:
    """The views by name, with their status."""
    views = {view.name: (view, "training") for view in scene.train}
    return views | {view.name: (view, "held out") for view in scene.eval}


def _world(content: _Content, work: Work) -> World | None:
    """Cameras in the order of the views, and points."""
    if content.scene is None:
        return None
    views = _with_status(content.scene)
    cameras = {
        view.name: views[view.name][0].camera for view in work.images.views if view.name in views
    }
    held_out = {view.name for view in content.scene.eval}
    north = work.georeference is not None and work.georeference.north
    return World(cameras, held_out, content.scene.points, work.metric, north)


def _overlays(content: _Content, work: Work) -> dict[str, Float32[np.ndarray, "h w"]]:
    """By the view's name, the thermal image warped onto the photo."""
    if content.posed is None or content.scene is None:
        return {}
    visible = content.posed.visible or {}
    found = {}
    for done, view in enumerate(content.previews):
        work.progress("drawing", done, len(content.previews))
        found[view.name] = thermal_overlay(view, content.posed.points, visible.get(view.name))
    return {name: image for name, image in found.items() if image is not None}


def _disagreements(content: _Content, work: Work) -> tuple[str, ...]:
    """A warning about thermal images that do not agree; none if they do."""
    pairs = zip(content.previews, content.agreements, strict=True)
    names = [view.name for view, agreement in pairs if agreement is not None and agreement.jumps]
    if not names:
        return ()
    radiometric = any(view.facts.record.is_radiometric for view in work.images.views)
    problem = jump(THERMAL, names, radiometric)
    return (f"{problem.text} {problem.remedy}",)


def _time(stage: StageReport) -> str:
    if stage.reused:
        return "from before"
    minutes, seconds = divmod(int(stage.seconds), 60)
    text = f"{minutes} min {seconds:02d} s" if minutes else f"{stage.seconds:.1f} s"
    return text.replace(" ", "\N{NO-BREAK SPACE}")


def _temperatures(content: _Content, photos: ConvertedPhotos) -> Temperatures | None:
    ranges = sum(view.range_c is not None for view in photos.views)
    without = len(photos.views) - ranges
    facts = [("Photos", f"{ranges} with °C" + (f", {without} without" if without else ""))]
    cameras = Counter(view.facts.camera for view in photos.views if view.facts.camera)
    if cameras:
        names = ", ".join(f"{name} ({count} photos)" for name, count in cameras.items())
        facts.append(("Thermal camera", names))
    if content.scene is not None and content.scene.temperature is not None:
        facts.append(("Range of the scene", str(content.scene.temperature)))
    if ranges:
        facts += setting_rows([view.facts.record for view in photos.views])
    notes = Counter(note for view in photos.views for note in view.facts.notes)
    return temperatures(content.previews, content.unit, facts, notes, content.total)


def _lenses(
    reconstruction: Reconstruction | None, georeference: Georeference | None
) -> list[tuple[str, str]]:
    """Facts about poses, lenses and scale; none without poses."""
    if reconstruction is None:
        return []
    rows = [("Poses", reconstruction.source)]
    if reconstruction.reprojection_px is not None:
        rows.append(("Reprojection error", f"{reconstruction.reprojection_px:.2f} px (mean)"))
    rows.append(("Points", f"{len(reconstruction.points.positions):,}"))
    lenses = {name: reconstruction.lenses[name] for name in reconstruction.viewmats}
    rows += lens_rows(lenses, f"{capitalised(reconstruction.images.title)} lens")
    if georeference is not None:
        rows.append(("Scale and north", georeference.text))
        if georeference.residual_m is not None:
            residual = f"{georeference.residual_m:.2f} m (median)"
            rows.append(("Distance from the GPS positions", residual))
    return rows


def _measured(work: Work, posed: Reconstruction | None) -> list[MeasuredPhoto]:
    """RGB photos with a pose, to measure a known distance in."""
    if posed is None or posed.images != RGB:
        return []
    return measured_photos(
        work.scene, [view for view in work.images.views if view.name in posed.viewmats]
    )
