"""The page that shows a checked scene and its problems."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mrgs.check.poses import cameras_by_modality
from mrgs.check.problems import Problem
from mrgs.check.statistics import ViewStatistics
from mrgs.data.transforms import pinhole_lens
from mrgs.pictures.values import capitalised
from mrgs.prepare.page.cameras import lens_rows
from mrgs.prepare.page.overlay import thermal_overlay
from mrgs.prepare.page.pairs import MOST_SHOWN, pairs
from mrgs.prepare.page.temperatures import setting_rows, temperatures
from mrgs.prepare.page.world import World, world_of
from mrgs.prepare.page.write import write_scene_page
from mrgs.scene import Scene
from mrgs.scene.view import evenly_spaced

PAGE = "check.html"


def write_check_page(
    folder: Path,
    problems: Sequence[Problem],
    lines: Sequence[str] = (),
    scene: Scene | None = None,
    statistics: Sequence[ViewStatistics] = (),
    output: Path | None = None,
) -> Path:
    """Write ``check.html``; returns its path.

    Args:
        folder: the scene's.
        problems: worst first.
        lines: facts about the scene, one sentence each.
        scene: None if it cannot be read.
        statistics: its views.
        output: folder of the page; by default the scene's.

    Raises:
        RunError: the page cannot be written.
    """
    return write_scene_page(
        (output or folder) / PAGE,
        "check/check.html",
        f"Scene check: {folder.resolve().name}",
        None if scene is None else _world(scene),
        problems=problems,
        errors=sum(problem.severity == "error" for problem in problems),
        lines=lines,
        north=scene is not None and scene.world.north,
        shown=None if scene is None else _shown(scene, statistics),
    )


def _world(scene: Scene) -> World:
    """Cameras and points."""
    cameras = {view.name: view.camera for view in scene.views}
    held_out = frozenset(view.name for view in scene.eval)
    return world_of(cameras, held_out, scene.points, scene.world.metric, scene.world.north)


def _shown(scene: Scene, statistics: Sequence[ViewStatistics]) -> dict[str, Any]:
    """Views, temperatures and lenses."""
    previews = [statistics[index].preview for index in evenly_spaced(len(statistics), MOST_SHOWN)]
    warped = {view.name: thermal_overlay(view, scene.points) for view in previews}
    overlays = {name: image for name, image in warped.items() if image is not None}
    unit = "" if scene.temperature is None else "°C"
    records = [] if scene.temperature is None else scene.records
    return {
        "pairs": pairs(previews, overlays, unit, len(statistics)),
        "temperatures": temperatures(
            [one.preview for one in statistics],
            unit,
            setting_rows(records) if records else [],
            {},
            len(statistics),
        ),
        "lenses": _lenses(scene),
    }


def _lenses(scene: Scene) -> list[tuple[str, str]]:
    return [
        row
        for modality, cameras in cameras_by_modality(scene).items()
        for row in lens_rows(
            {name: pinhole_lens(camera) for name, camera in cameras.items()},
            capitalised(modality.title),
        )
    ]
