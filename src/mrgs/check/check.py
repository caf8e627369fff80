"""Look a scene over: read it, draw its cameras and points, and list what is wrong."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from datetime import date
from html import escape
from pathlib import Path
from typing import Any

from mrgs.check.images import image_problems
from mrgs.check.looks import Look, look_at
from mrgs.check.poses import pose_problems
from mrgs.check.problems import Problem, SceneCheck, worst_first
from mrgs.data import load_scene
from mrgs.data.files import scene_error
from mrgs.data.lens import Lens
from mrgs.errors import MrgsWarning, SceneError
from mrgs.prepare.contract import Progress
from mrgs.prepare.page.cameras import lens_rows, world_section
from mrgs.prepare.page.charts import span_of
from mrgs.prepare.page.document import write_document
from mrgs.prepare.page.markup import bullets, fact_table, paragraph, section
from mrgs.prepare.page.overlay import thermal_on_rgb
from mrgs.prepare.page.pairs import MOST_SHOWN, pairs_section, thumbnail_width
from mrgs.prepare.page.temperatures import temperatures_section
from mrgs.prepare.page.world import orbit_facts, world_of
from mrgs.scene import Camera, Scene
from mrgs.scene.view import spread

PAGE = "check.html"


def check_scene(scene: str | Path, progress: Progress | None = None) -> SceneCheck:
    """Look a scene over that was made elsewhere, in any layout that ``load_scene`` reads; nothing
    in it is changed.

    Every image is read once. Beside the scene's files a page ``check.html`` is written that shows
    cameras and points, each view with its thermal image laid over its photo, temperatures and
    lenses.

    Args:
        scene: the folder, or its transforms file.
        progress: called with a step's name, and how many views are done and there are.

    Raises:
        SceneError: there is no such folder.
        RunError: the page cannot be written.
    """
    scene = Path(scene)
    folder = scene if scene.is_dir() else scene.parent
    if not scene.is_dir() and not (scene.is_file() and scene.suffix == ".json"):
        raise scene_error(scene, "is not a folder; give the folder that holds the scene")
    report = progress or (lambda step, done, total: None)
    try:
        loaded, mended = _load(scene)
    except SceneError as error:
        unread = (Problem("error", str(error)),)
        return SceneCheck(unread, (), _write_page(folder, unread, (), [], {}))
    looks = _looks(loaded, report)
    found = [*mended, *pose_problems(loaded), *image_problems(loaded, looks)]
    problems = worst_first(found)
    lines = _facts(loaded)
    sections, facts = _pictures(loaded, looks)
    return SceneCheck(problems, lines, _write_page(folder, problems, lines, sections, facts))


def _load(scene: Path) -> tuple[Scene, list[Problem]]:
    """The scene, and what the reader had to mend."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", MrgsWarning)
        loaded = load_scene(scene)
    mended = [str(item.message).removeprefix(f"{loaded.name}: ") for item in caught]
    remedy = "It is mended on each reading; correct the file."
    return loaded, [Problem("warning", text, remedy) for text in mended]


def _looks(scene: Scene, report: Progress) -> list[Look]:
    """Every view, looked at, those to train on first."""
    views = [(view, "training") for view in scene.train] + [
        (view, "held out") for view in scene.eval
    ]
    width = thumbnail_width(len(views))
    looks = []
    for done, (view, status) in enumerate(views):
        report("reading images", done, len(views))
        looks.append(look_at(view, status, scene.temperature, width))
    report("reading images", len(views), len(views))
    return looks


def _facts(scene: Scene) -> tuple[str, ...]:
    """What the scene holds, one sentence each."""
    lines = [f"{len(scene.train)} views to train on, {len(scene.eval)} held out."]
    views = [*scene.train, *scene.eval]
    rgb = [view.rgb.camera for view in views if view.rgb is not None]
    thermal = [view.thermal.camera for view in views if view.thermal is not None]
    for kind, cameras in (("RGB", rgb), ("thermal", thermal)):
        if sizes := sorted({(camera.width, camera.height) for camera in cameras}):
            lines.append(
                f"{len(cameras)} {kind} images, {', '.join(f'{w}×{h}' for w, h in sizes)} px."
            )
    if scene.temperature is not None:
        lines.append(
            f"Temperatures from {scene.temperature.min_c:g} to {scene.temperature.max_c:g} °C."
        )
    lines.append(
        f"{len(scene.points.positions):,} start points; the cameras span {2 * scene.extent:.3g} "
        f"units."
    )
    return (*lines, *scene.notes)


def _pictures(scene: Scene, looks: Sequence[Look]) -> tuple[list[str], dict[str, Any]]:
    """The sections that show the scene, and what the page's scripts read."""
    views = [*scene.train, *scene.eval]
    held_out = frozenset(view.name for view in scene.eval)
    world = world_of(
        {view.name: view.cameras[0] for view in views}, held_out, scene.points, False, False
    )
    shown = [looks[index].shot for index in spread(len(looks), MOST_SHOWN)]
    overlays = {
        shot.name: overlay
        for shot in shown
        if (overlay := thermal_on_rgb(shot, scene.points)) is not None
    }
    unit = "" if scene.temperature is None else "°C"
    spans = [span for look in looks if look.shot.thermal is not None
             and (span := span_of(look.shot.name, look.shot.thermal))]  # fmt: skip
    sections = [
        world_section(world),
        pairs_section(shown, overlays, unit, len(looks)),
        temperatures_section([look.shot for look in looks], spans, unit, [], {}),
        _lenses(scene),
    ]
    return sections, {"orbit": orbit_facts(world)}


def _lenses(scene: Scene) -> str:
    views = [*scene.train, *scene.eval]
    rgb = {view.name: _lens(view.rgb.camera) for view in views if view.rgb}
    thermal = {view.name: _lens(view.thermal.camera) for view in views if view.thermal}
    note = paragraph("As the pinhole cameras to which the images are undistorted.", "note")
    rows = [*lens_rows(rgb, "RGB"), *lens_rows(thermal, "Thermal")]
    return section("cameras", "Lenses", note + fact_table(rows))


def _lens(camera: Camera) -> Lens:
    fx, fy, cx, cy = camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return Lens(camera.width, camera.height, fx, fy, cx, cy)


def _write_page(
    folder: Path,
    problems: Sequence[Problem],
    lines: Sequence[str],
    sections: Sequence[str],
    facts: dict[str, Any],
) -> Path:
    title = f"Scene check: {folder.resolve().name}"
    subtitle = f"{date.today().isoformat()}. {folder}"
    sections = [_summary(problems, lines), *sections]
    return write_document(folder / PAGE, title, subtitle, sections, {"orbit": None, **facts})


def _summary(problems: Sequence[Problem], lines: Sequence[str]) -> str:
    errors = sum(problem.severity == "error" for problem in problems)
    if errors:
        lead = (
            f"{errors} error{'' if errors == 1 else 's'}: the scene will not train, or not "
            f"give what it should."
        )
    elif problems:
        lead = "The scene can be trained on. What could make the model worse:"
    else:
        lead = "Nothing wrong was found."
    items = "".join(
        f'<li class="{problem.severity}"><b>{problem.severity.capitalize()}:</b> '
        f"{escape(problem.text)}"
        + (f"<span>{escape(problem.remedy)}</span>" if problem.remedy else "")
        + "</li>"
        for problem in problems
    )
    listing = f'<ul class="problems">{items}</ul>' if items else ""
    facts = f"<h2>What it holds</h2>{bullets(lines)}" if lines else ""
    return f'<section id="summary">{paragraph(lead, "lead")}{listing}{facts}</section>'
