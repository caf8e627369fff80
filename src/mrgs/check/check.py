"""Check a scene: read it, list its problems, and draw it on a page."""

from __future__ import annotations

import warnings
from pathlib import Path

from mrgs.check.images import image_problems
from mrgs.check.page import write_check_page
from mrgs.check.poses import cameras_by_modality, pose_problems
from mrgs.check.problems import Problem, SceneCheck, worst_first
from mrgs.check.statistics import ViewStatistics, measure_view
from mrgs.data import load_scene
from mrgs.data.colmap_model import MODEL_FOLDERS
from mrgs.data.files import scene_error
from mrgs.errors import MrgsWarning, SceneError
from mrgs.prepare.contract import Progress
from mrgs.prepare.page.pairs import thumbnail_width
from mrgs.scene import Scene


def check_scene(
    scene: str | Path, progress: Progress | None = None, output: Path | None = None
) -> SceneCheck:
    """Check a scene in any layout that ``load_scene`` reads; nothing in it is changed.

    Every image is read once, large photos at a fraction of their size. The page ``check.html`` in
    the scene's folder shows cameras and points, each view with its thermal image over its photo,
    temperatures and lenses.

    Args:
        scene: the folder, or its transforms file.
        progress: called with a step's name, and how many views are done and there are.
        output: folder of the page; by default the scene's.

    Raises:
        SceneError: there is no such folder, or it holds no scene.
        RunError: the page cannot be written.
    """
    scene = Path(scene)
    folder = scene if scene.is_dir() else scene.parent
    if not scene.is_dir() and not (scene.is_file() and scene.suffix == ".json"):
        raise scene_error(scene, "not a folder; give the scene's folder")
    report = progress or (lambda step, done, total: None)
    try:
        loaded, corrected = _load(scene)
    except SceneError as error:
        if not _has_cameras(scene):
            raise
        unread = (Problem("error", str(error)),)
        return SceneCheck(unread, (), write_check_page(folder, unread, output=output))
    statistics = _read_views(loaded, report)
    found = [*corrected, *pose_problems(loaded), *image_problems(loaded, statistics)]
    problems = worst_first(found)
    lines = _facts(loaded)
    return SceneCheck(
        problems, lines, write_check_page(folder, problems, lines, loaded, statistics, output)
    )


def _load(scene: Path) -> tuple[Scene, list[Problem]]:
    """The scene, and what the reader corrected."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", MrgsWarning)
        loaded = load_scene(scene)
    corrected = [str(item.message).removeprefix(f"{loaded.name}: ") for item in caught]
    remedy = "It is corrected at each reading; fix the file."
    return loaded, [Problem("warning", text, remedy) for text in corrected]


def _has_cameras(scene: Path) -> bool:
    """Whether this is a camera file, or a folder with one, readable or not."""
    patterns = ("transforms*.json", *(f"{folder}/cameras.*" for folder in MODEL_FOLDERS))
    return scene.is_file() or any(any(scene.glob(pattern)) for pattern in patterns)


def _read_views(scene: Scene, report: Progress) -> list[ViewStatistics]:
    """Statistics of every view, training views first."""
    views = [(view, "training") for view in scene.train] + [
        (view, "held out") for view in scene.eval
    ]
    width = thumbnail_width(len(views))
    statistics = []
    for done, (view, status) in enumerate(views):
        report("reading images", done, len(views))
        statistics.append(measure_view(view, status, scene.temperature, width))
    report("reading images", len(views), len(views))
    return statistics


def _facts(scene: Scene) -> tuple[str, ...]:
    """Contents of the scene, one sentence each."""
    lines = [f"{len(scene.train)} training views, {len(scene.eval)} held out."]
    for modality, cameras in cameras_by_modality(scene).items():
        sizes = sorted({(camera.width, camera.height) for camera in cameras.values()})
        lines.append(
            f"{len(cameras)} {modality.title} images, "
            f"{', '.join(f'{width}×{height}' for width, height in sizes)} px."
        )
    if scene.temperature is not None:
        lines.append(f"Temperatures from {scene.temperature}.")
    lines.append(
        f"{len(scene.points.positions):,} start points; the cameras span {2 * scene.extent:.3g} "
        f"{scene.world.length_unit}."
    )
    return (*lines, *scene.notes)
