"""The page of a prepared scene, which shows mistakes before training: pictures, and cameras and
points in 3D, from above and from the side."""

from __future__ import annotations

import base64
import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree
from torch import Tensor

from mrgs.check import Problem
from mrgs.check.photos import agreements, jump
from mrgs.data import load_scene
from mrgs.data.transforms import TRANSFORMS
from mrgs.pictures.html import PAGE_STYLE, script_json, write_html
from mrgs.pictures.page_data import BASE64_SCRIPT, GEOMETRY_SCRIPT, camera_facts, world_facts
from mrgs.pictures.values import capitalised
from mrgs.prepare.contract import Georeference, Reconstruction, Skipped, StageReport
from mrgs.prepare.page.temperatures import setting_rows, temperatures
from mrgs.prepare.page.views import (
    MOST_SHOWN,
    Preview,
    measured_photos,
    pairs,
    preview_of_files,
    preview_of_pixels,
    thermal_overlays,
    thumbnail_width,
)
from mrgs.prepare.rig.contract import RigCalibration
from mrgs.prepare.work import Work
from mrgs.scene import RGB, THERMAL, Camera, PointCloud, Scene, View
from mrgs.scene.camera import field_of_view
from mrgs.scene.lens import Lens
from mrgs.scene.view import evenly_spaced
from mrgs.system.wording import counted, quoted

PAGE = "prepare.html"
SCRIPTS = (
    BASE64_SCRIPT,
    GEOMETRY_SCRIPT,
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
    posed = None if work.poses is None else work.posed
    shown = evenly_spaced(len(work.images.views), most_shown)
    width = thumbnail_width(len(shown))
    written = posed is not None and (work.scene / TRANSFORMS).is_file()
    scene = load_scene(work.scene, resolution=width) if written else None
    previews = _previews(work, scene, posed, shown, width)
    has_celsius = any(view.range_c is not None for view in work.images.views)
    has_celsius |= scene is not None and scene.temperature is not None
    unit = "°C" if has_celsius else ""
    overlays, notes = {}, tuple[str, ...]()
    if scene is not None and posed is not None:
        if (found := _disagreement(work, previews, posed)) is not None:
            notes = (f"{found.text} {found.remedy}",)
            work.found_by_page = notes if found.severity == "warning" else ()
        overlays = thermal_overlays(previews, posed.points, posed.visible, work.progress)
    warnings = [text for stage in work.reports for text in stage.warnings]
    skipped = [(item.name, item.reason) for item in (*work.skipped, *without_pose)]
    return write_scene_page(
        work.scene / PAGE,
        "prepare/page/prepare.html",
        f"Prepared scene: {work.scene.resolve().name}",
        World.of(scene),
        views=None
        if scene is None
        else {
            "training": len(scene.train),
            "held_out": len(scene.eval),
            "total": len(work.images.views),
        },
        has_celsius=has_celsius,
        folder=quoted(work.scene),
        trains=work.trains,
        warnings=list(dict.fromkeys((*warnings, *notes))),
        stages=[(stage.title, " ".join(stage.lines), _time(stage)) for stage in work.reports],
        pairs=pairs(previews, overlays, unit, len(work.images.views)),
        temperatures=_temperatures(work, previews, scene, unit),
        control=() if work.georeference is None else work.georeference.control,
        lenses=[] if posed is None else _pose_rows(posed, work.georeference),
        rig=None if work.rig is None else _rig_facts(work.rig, work.metric),
        one_camera=scene is not None and posed is not None and posed.images != THERMAL,
        photos=[]
        if posed is None or posed.images != RGB
        else measured_photos(
            work.scene, [view for view in work.images.views if view.name in posed.viewmats]
        ),
        metric=work.metric,
        skipped=list(dict.fromkeys(skipped)),
    )


def write_scene_page(
    path: Path, template: str, title: str, world: World | None, **values: Any
) -> Path:
    """Write a page that shows a scene, by a template that extends ``scene.html``; returns its path.
    RunError if the file cannot be written."""
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


def _previews(
    work: Work, scene: Scene | None, posed: Reconstruction | None, shown: Sequence[int], width: int
) -> list[Preview]:
    """The views that are shown: as the scene has them, else from their files."""
    temperature = None if scene is None else scene.temperature
    views: dict[str, tuple[View, str]] = {}
    if scene is not None:
        views |= {view.name: (view, "training") for view in scene.train}
        views |= {view.name: (view, "held out") for view in scene.eval}
    failed = {} if posed is None else {item.name: item.reason for item in posed.failed}
    previews = []
    for done, index in enumerate(shown):
        work.progress("reading images", done, len(shown))
        own = work.images.views[index]
        if own.name in views:
            view, status = views[own.name]
            pixels = {modality: image.load() for modality, image in view.images.items()}
            previews.append(preview_of_pixels(view, status, temperature, width, pixels))
            continue
        reason = "in no scene yet"
        if own.name in failed:
            reason = f"not in the scene: {failed[own.name]}"
        previews.append(preview_of_files(work.scene, own, reason, temperature, width))
    return previews


def _disagreement(work: Work, previews: Sequence[Preview], posed: Reconstruction) -> Problem | None:
    """What to say of thermal images that disagree at the points that they show; None if none do."""
    images = [view.images.get(THERMAL) if view.registered else None for view in previews]
    found = agreements(
        [None if image is None else image.pixels for image in images],
        [None if image is None else image.camera for image in images],
        posed.points,
    )
    pairs = zip(previews, found, strict=True)
    names = [view.name for view, agreement in pairs if agreement is not None and agreement.jumps]
    if not names:
        return None
    radiometric = any(view.facts.record.is_radiometric for view in work.images.views)
    return jump(THERMAL, names, radiometric)


def _time(stage: StageReport) -> str:
    if stage.reused:
        return "from before"
    minutes, seconds = divmod(int(stage.seconds), 60)
    text = f"{minutes} min {seconds:02d} s" if minutes else f"{stage.seconds:.1f} s"
    return text.replace(" ", "\N{NO-BREAK SPACE}")


def _temperatures(
    work: Work, previews: Sequence[Preview], scene: Scene | None, unit: str
) -> dict[str, Any] | None:
    views = work.images.views
    ranges = sum(view.range_c is not None for view in views)
    without = f", {len(views) - ranges} without" if ranges < len(views) else ""
    facts = [("Photos", f"{ranges} with °C{without}")]
    cameras = Counter(view.facts.camera for view in views if view.facts.camera)
    if cameras:
        names = ", ".join(f"{name} ({count} photos)" for name, count in cameras.items())
        facts.append(("Thermal camera", names))
    if scene is not None and scene.temperature is not None:
        facts.append(("Range of the scene", str(scene.temperature)))
    if ranges:
        facts += setting_rows([view.facts.record for view in views])
    notes = Counter(note for view in views for note in view.facts.notes)
    return temperatures(previews, unit, facts, notes, len(views))


def _pose_rows(posed: Reconstruction, georeference: Georeference | None) -> list[tuple[str, str]]:
    """Facts about poses, lenses and scale."""
    rows = [("Poses", posed.source)]
    if posed.reprojection_px is not None:
        rows.append(("Reprojection error", f"{posed.reprojection_px:.2f} px (mean)"))
    rows.append(("Points", f"{len(posed.points.positions):,}"))
    lenses = {name: posed.lenses[name] for name in posed.viewmats}
    rows += lens_rows(lenses, f"{capitalised(posed.images.title)} lens")
    if georeference is not None:
        rows.append(("Scale and north", georeference.text))
        if georeference.residual_m is not None:
            residual = f"{georeference.residual_m:.2f} m (median)"
            rows.append(("Distance from the GPS positions", residual))
    return rows


def lens_rows(lenses: Mapping[str, Lens], what: str) -> list[tuple[str, str]]:
    """A row for each distinct lens, with the number of its views."""
    return [
        (f"{what}, {counted(count, 'view')}", lens_text(lens))
        for lens, count in Counter(lenses.values()).items()
    ]


def lens_text(lens: Lens) -> str:
    """Size, field of view, focal length, principal point and distortion, in a sentence."""
    wide, high = (
        math.degrees(field_of_view(pixels, focal))
        for pixels, focal in ((lens.width, lens.fx), (lens.height, lens.fy))
    )
    coefficients = zip(
        ("k1", "k2", "k3", "k4", "p1", "p2"), (*lens.radial, *lens.tangential), strict=True
    )
    bent = ", ".join(f"{name} {value:.4g}" for name, value in coefficients if value)
    model = "fisheye " if lens.fisheye else ""
    return (
        f"{lens.width} × {lens.height} px, {wide:.1f}° × {high:.1f}°, focal length {lens.fx:.1f} "
        f"× {lens.fy:.1f} px, centre {lens.cx:.1f}, {lens.cy:.1f} px, "
        + (f"{model}distortion {bent}" if bent else f"{model or 'no '}distortion")
    )


def _rig_facts(rig: RigCalibration, metric: bool) -> dict[str, Any]:
    """The calibrated thermal camera: rows of facts, and a row for each view with its matches,
    residual and uncertainty, the least certain first."""
    median, most = rig.residual_px
    angle_deg = math.degrees(torch.acos(rig.extrinsics[2, 2].clamp(-1, 1)).item())
    rows = [
        ("Thermal lens", lens_text(rig.lens)),
        ("Distance between the lenses", _offset(rig.extrinsics, metric)),
        ("Angle between the axes", f"{angle_deg:.2f}°"),
        (
            "Residual",
            f"{median:.2f} px (median), {most:.2f} px (90th percentile), in thermal pixels",
        ),
        ("Uncertainty", f"{rig.uncertainty_px:.2f} px (one standard deviation)"),
        ("Motion between pairs", f"{rig.motion_px:.2f} px (median)"),
    ]
    if rig.target is not None:
        seen, fit = rig.target.pairs, rig.target.residual_px[0]
        text = f"seen by both cameras in {seen} pairs; median residual {fit:.2f} px"
        rows.append(("Chessboard", text))
    views = sorted(rig.views, key=lambda view: (-min(view.uncertainty_px, 1e9), view.name))
    return {
        "rows": rows,
        "views": [
            (each.name, str(each.matches), _number(each.residual_px), _number(each.uncertainty_px))
            for each in views
        ],
    }


def _offset(extrinsics: Float64[Tensor, "4 4"], metric: bool) -> str:
    """Distance and direction of the thermal camera from the photos' camera."""
    position = -extrinsics[:3, :3].T @ extrinsics[:3, 3]
    factor, unit, digits = (100.0, "cm", 1) if metric else (1.0, "scene units", 4)
    words = (("right", "left"), ("below", "above"), ("ahead", "behind"))
    parts = [
        f"{abs(value) * factor:.{digits}f} {plus if value >= 0 else minus}"
        for value, (plus, minus) in zip(position.tolist(), words, strict=True)
    ]
    return (
        f"{position.norm().item() * factor:.{digits}f} {unit}: the thermal camera is "
        f"{', '.join(parts)}"
    )


def _number(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "not known"


Vector: TypeAlias = Float[np.ndarray, "3"]

MOST_POINTS = 4000
_TRIM = 0.08
"""Share of the points, at each end of each axis, that does not extend the box."""

_NEAR, _FAR = 2.5, 50.0
"""Distances from which the scene is seen, over the length that fills the view."""


class World(NamedTuple):
    """Cameras of the first image of each view, by the view's name, at least one; the views that are
    not trained on; points; whether scene units are metres; and whether the axes are east, north,
    up. Otherwise up is the mean direction of the cameras' upper edges."""

    cameras: Mapping[str, Camera]
    held_out: Collection[str]
    points: PointCloud
    metric: bool
    north: bool

    @classmethod
    def of(cls, scene: Scene | None) -> World | None:
        """The cameras and points of a scene."""
        if scene is None:
            return None
        cameras = {view.name: view.camera for view in scene.views}
        held_out = {view.name for view in scene.eval}
        return cls(cameras, held_out, scene.points, scene.world.metric, scene.world.north)


def orbit_facts(world: World) -> dict[str, Any]:
    """Data for ``orbit.js``; points are 16-bit integers in steps of ``step`` from ``low``."""
    chosen = evenly_spaced(len(world.points.positions), MOST_POINTS)
    points = world.points.positions[chosen].double().numpy()
    colors = world.points.colors[chosen].clamp(0, 1).numpy()
    positions = np.stack([camera.position.numpy() for camera in world.cameras.values()])
    low, high = _box(positions, points)
    size = float((high - low).max())
    corner, step = low - 0.5 * size, 2 * size / 65535
    quantised = np.rint((points - corner) / step)
    inside = ((quantised >= 0) & (quantised <= 65535)).all(axis=1)
    up = np.array([0.0, 0, 1] if world.north else world_facts([*world.cameras.values()])["up"])
    return {
        "cameras": [
            {"name": name, "heldOut": name in world.held_out, **camera_facts(camera)}
            for name, camera in world.cameras.items()
        ],
        "points": base64.b64encode(quantised[inside].astype("<u2").tobytes()).decode(),
        "colors": base64.b64encode(np.rint(colors[inside] * 255).astype("u1").tobytes()).decode(),
        "low": corner.tolist(),
        "step": step,
        "frustum": frustum_size(positions, float(np.linalg.norm(high - low))),
        "metric": world.metric,
        "world": {"focus": ((low + high) / 2).tolist(), "up": up.tolist()},
        "views": _viewpoints(world, up, low, high),
    }


def _box(
    positions: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "k 3"]
) -> tuple[Vector, Vector]:
    """The box of the cameras and of nearly all points."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    if len(points):
        low = np.minimum(low, np.quantile(points, _TRIM, axis=0))
        high = np.maximum(high, np.quantile(points, 1 - _TRIM, axis=0))
    return (low, high) if (high - low).max() > 0 else (low - 1, high + 1)


def frustum_size(positions: Float[np.ndarray, "n 3"], size: float) -> float:
    """Drawn depth of the cameras' pyramids: large enough to see, and hardly touching each other."""
    nearest = np.inf
    if len(positions) > 1:
        nearest = np.median(cKDTree(positions).query(positions, k=2)[0][:, 1])
    return float(np.clip(0.8 * nearest, 0.02 * size, 0.06 * size))


def _viewpoints(world: World, up: Vector, low: Vector, high: Vector) -> dict[str, Any]:
    """Cameras that see the whole box: aslant, from above, and from the side."""
    ahead = np.array([0.0, 1.0, 0.0])
    if not world.north:
        directions = np.stack([camera.forward.numpy() for camera in world.cameras.values()])
        for found in (directions.mean(axis=0), directions[0], np.eye(3)[np.abs(up).argmin()]):
            ahead = found - up * (found @ up)
            if np.linalg.norm(ahead) > 0.1:
                break
        ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, up)

    def seen_from(side: Vector, top: Vector, far: float, length: float) -> dict[str, Any]:
        lens = Camera.from_fov(400, 400, 2 * math.degrees(math.atan(0.5 / far)))
        centre = (low + high) / 2
        return camera_facts(lens.look_at(centre + far * length * side, centre, top))

    def extent(*axes: Vector) -> float:
        return 1.08 * max(float(np.abs(axis) @ (high - low)) for axis in axes)

    aslant = 0.5 * up - 0.7 * ahead + 0.5 * right
    return {
        "orbit": seen_from(aslant, up, _NEAR, 0.8 * float(np.linalg.norm(high - low))),
        "above": seen_from(up, ahead, _FAR, extent(right, ahead)),
        "side": seen_from(-ahead, up, _FAR, extent(right, up)),
    }
