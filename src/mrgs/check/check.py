"""Look a scene over: read it, draw its cameras and points, and list what is wrong."""

from __future__ import annotations

import warnings
from pathlib import Path

from mrgs.check.images import image_problems
from mrgs.check.looks import Look, look_at
from mrgs.check.page import write_check_page
from mrgs.check.poses import pose_problems
from mrgs.check.problems import Problem, SceneCheck, worst_first
from mrgs.data import load_scene
from mrgs.data.files import scene_error
from mrgs.errors import MrgsWarning, SceneError
from mrgs.prepare.contract import Progress
from mrgs.prepare.page.pairs import thumbnail_width
from mrgs.scene import Scene


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
        return SceneCheck(unread, (), write_check_page(folder, unread))
    looks = _looks(loaded, report)
    found = [*mended, *pose_problems(loaded), *image_problems(loaded, looks)]
    problems = worst_first(found)
    lines = _facts(loaded)
    return SceneCheck(problems, lines, write_check_page(folder, problems, lines, loaded, looks))


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
