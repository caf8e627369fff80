"""``mrgs check``: the problems of a scene in any layout, and a page that shows it."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mrgs.check.photos import WIDTH_PX, measure
from mrgs.check.problem import Evidence, ImageStatistics, Problem, cameras_by_modality, worst_first
from mrgs.check.rules import find_problems
from mrgs.data import load_scene
from mrgs.data.colmap import MODEL_FOLDERS
from mrgs.data.transforms import pinhole_lens
from mrgs.errors import MrgsWarning, SceneError, scene_error
from mrgs.pictures.values import capitalised
from mrgs.prepare.contract import Progress
from mrgs.prepare.page.temperatures import setting_rows, temperatures
from mrgs.prepare.page.views import (
    MOST_SHOWN,
    Preview,
    pairs,
    preview_of_pixels,
    thermal_overlays,
    thumbnail_width,
)
from mrgs.prepare.page.write import World, lens_rows, write_scene_page
from mrgs.scene import Modality, Pixels, Scene
from mrgs.scene.view import evenly_spaced

PAGE = "check.html"


@dataclass(frozen=True)
class SceneCheck:
    """Result of ``check_scene``: the problems, worst first; facts about the scene, one sentence
    each; and the page that shows it."""

    problems: tuple[Problem, ...]
    lines: tuple[str, ...]
    page: Path

    @property
    def usable(self) -> bool:
        """Whether there is no error among the problems."""
        return all(problem.severity != "error" for problem in self.problems)


def check_scene(
    scene: str | Path, progress: Progress | None = None, output: Path | None = None
) -> SceneCheck:
    """Check a scene in any layout that ``load_scene`` reads; nothing in it is changed.

    Every image is read once, large photos at a fraction of their size. The page ``check.html`` in
    the scene's folder shows cameras and points, each view with its thermal image over its photo,
    temperatures and lenses.

    Args:
        scene: the folder, or its transforms file.
        output: folder of the page; by default the scene's.

    Raises:
        SceneError: there is no such folder, or no scene in it.
        RunError: the page cannot be written.
    """
    scene = Path(scene)
    folder = scene if scene.is_dir() else scene.parent
    if not scene.is_dir() and not (scene.is_file() and scene.suffix == ".json"):
        raise scene_error(scene, "not a folder; give the scene's folder")
    page = (output or folder) / PAGE
    try:
        loaded, corrected = _load(scene)
    except SceneError as error:
        patterns = ("transforms*.json", *(f"{each}/cameras.*" for each in MODEL_FOLDERS))
        if not (scene.is_file() or any(any(scene.glob(pattern)) for pattern in patterns)):
            raise
        unread = (Problem("error", str(error)),)
        return SceneCheck(unread, (), _write(page, folder, unread))
    previews, evidence = _read_views(loaded, progress or (lambda step, done, total: None))
    problems = worst_first([*corrected, *find_problems(evidence)])
    lines = _facts(loaded)
    return SceneCheck(problems, lines, _write(page, folder, problems, lines, loaded, previews))


def _load(scene: Path) -> tuple[Scene, list[Problem]]:
    """The scene, and what the reader corrected."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", MrgsWarning)
        loaded = load_scene(scene)
    corrected = [str(item.message).removeprefix(f"{loaded.name}: ") for item in caught]
    remedy = "It is corrected at each reading; fix the file."
    return loaded, [Problem("warning", text, remedy) for text in corrected]


def _read_views(scene: Scene, report: Progress) -> tuple[list[Preview], Evidence]:
    """The preview of every view, training views first, and the statistics of its photos; a photo
    that cannot be read is missing in both."""
    width = thumbnail_width(len(scene.views))
    previews: list[Preview] = []
    photos: dict[Modality, dict[str, ImageStatistics]] = {each: {} for each in scene.modalities}
    unreadable: list[str] = []
    for done, view in enumerate(scene.views):
        report("reading images", done, len(scene.views))
        pixels: dict[Modality, Pixels] = {}
        for modality, image in view.images.items():
            try:
                pixels[modality] = image.look(WIDTH_PX)
            except SceneError as error:
                unreadable.append(str(error))
                continue
            photos.setdefault(modality, {})[view.name] = measure(pixels[modality], image)
        status = "training" if done < len(scene.train) else "held out"
        previews.append(preview_of_pixels(view, status, scene.temperature, width, pixels))
    report("reading images", len(scene.views), len(scene.views))
    return previews, Evidence(scene, photos, unreadable)


def _facts(scene: Scene) -> tuple[str, ...]:
    """Contents of the scene, one sentence each."""
    lines = [f"{len(scene.train)} training views, {len(scene.eval)} held out."]
    for modality, cameras in cameras_by_modality(scene).items():
        sizes = sorted({(camera.width, camera.height) for camera in cameras.values()})
        shown = ", ".join(f"{width}×{height}" for width, height in sizes)
        lines.append(f"{len(cameras)} {modality.title} images, {shown} px.")
    if scene.temperature is not None:
        lines.append(f"Temperatures from {scene.temperature}.")
    lines.append(
        f"{len(scene.points.positions):,} start points; the cameras span {2 * scene.extent:.3g} "
        f"{scene.world.length_unit}."
    )
    return (*lines, *scene.notes)


def _write(
    page: Path,
    folder: Path,
    problems: Sequence[Problem],
    lines: Sequence[str] = (),
    scene: Scene | None = None,
    previews: Sequence[Preview] = (),
) -> Path:
    """Write the page; the scene is None if it cannot be read."""
    shown = None
    if scene is not None:
        views = [previews[index] for index in evenly_spaced(len(previews), MOST_SHOWN)]
        unit = "" if scene.temperature is None else "°C"
        settings = setting_rows(scene.records) if unit and scene.records else []
        shown = {
            "pairs": pairs(views, thermal_overlays(views, scene.points), unit, len(previews)),
            "temperatures": temperatures(previews, unit, settings, {}, len(previews)),
            "lenses": [
                row
                for modality, cameras in cameras_by_modality(scene).items()
                for row in lens_rows(
                    {name: pinhole_lens(camera) for name, camera in cameras.items()},
                    capitalised(modality.title),
                )
            ],
        }
    return write_scene_page(
        page,
        "prepare/page/check.html",
        f"Scene check: {folder.resolve().name}",
        World.of(scene),
        problems=problems,
        errors=sum(problem.severity == "error" for problem in problems),
        lines=lines,
        shown=shown,
    )
