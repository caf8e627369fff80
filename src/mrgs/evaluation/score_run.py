"""Score a run, and write its pictures: what ``mrgs eval`` and ``mrgs render`` do."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import UInt8

from mrgs.errors import ConfigError, SceneError
from mrgs.evaluation.contact_sheet import SheetRow, contact_sheet, sheet_row
from mrgs.evaluation.evaluate import Metrics, ViewMetrics, evaluate
from mrgs.evaluation.lpips import Lpips
from mrgs.evaluation.palette import PaletteName, colorize
from mrgs.evaluation.paths import orbit
from mrgs.evaluation.pictures import thermal_values, to_rgb8, write_png, write_rendering
from mrgs.evaluation.report import RunFacts, write_report
from mrgs.evaluation.truth import Truth
from mrgs.evaluation.video import write_frames
from mrgs.render import Rendering, render, render_view
from mrgs.run import Run
from mrgs.scene import Camera, View, spread

PATH_FRAMES = 120

Progress = Callable[[int, int], None]
"""Called with the number of images done and of all images."""


def evaluate_run(run: Run, lpips_weights: Path | None = None, progress: Progress | None = None) -> Metrics:
    """Score the run on its scene's eval views.

    Writes ``metrics.json``, ``metrics.md`` and ``contact_sheet.png`` into the run's folder ``eval``.

    Args:
        run: what ``load_run`` returns.
        lpips_weights: weights for LPIPS; without them it is left out, with the reason.
        progress: called after each view.

    Raises:
        SceneError: the scene cannot be read, or has no eval views.
        RunError: the weights cannot be read, or a file cannot be written.
    """
    scene = run.load_scene()
    if not scene.eval:
        raise SceneError(
            f"{run.facts.scene}: no views are held out, so there is nothing to score; put 'eval' into the file names "
            "of some, or list them in val_filenames, and train anew"
        )
    lpips = None if lpips_weights is None else Lpips.from_file(lpips_weights)
    shown = spread(len(scene.eval))
    rows: list[SheetRow] = []
    done = 0

    def visit(view: View, rendering: Rendering, metrics: ViewMetrics) -> None:
        nonlocal done
        if done in shown:
            rows.append(sheet_row(view, rendering, metrics, scene.temperature))
        done += 1
        if progress is not None:
            progress(done, len(scene.eval))

    metrics = evaluate(
        scene.eval,
        lambda view: render_view(run.model, view),
        scene.temperature,
        lpips,
        Truth.find(_scene_folder(run)),
        visit,
    )
    folder = run.folder.path / "eval"
    write_report(folder, facts_of(run), metrics)
    write_png(folder / "contact_sheet.png", contact_sheet(rows, facts_of(run), metrics, scene.temperature))
    return metrics


def facts_of(run: Run) -> RunFacts:
    """What the report says about a run besides its figures."""
    return RunFacts(
        method=run.config.method,
        scene=_scene_folder(run).name,
        steps=run.facts.step,
        gaussians=len(run.model.gaussians),
        train_seconds=run.facts.train_seconds,
        peak_memory_bytes=run.facts.peak_memory_bytes or None,
        device="cpu",
    )


def _scene_folder(run: Run) -> Path:
    """The folder of the run's scene, which may have been given as its transforms file."""
    path = Path(run.facts.scene)
    return path.parent if path.is_file() else path


def render_run(
    run: Run,
    split: Literal["eval", "train", "path"] = "eval",
    palette: PaletteName = "inferno",
    frames: int = PATH_FRAMES,
    progress: Progress | None = None,
) -> Path:
    """Write the run's images of a split into the run's folder ``renders/SPLIT``; returns that folder.

    Per view: RGB as PNG, temperature as float32 °C TIFF and as PNG with a scale bar, both depths. For ``path``, a
    camera path around the scene: frames of both modalities as PNG, and as mp4 where the extra ``video`` is installed.

    Raises:
        SceneError: the scene cannot be read.
        ConfigError: the split has no views.
        RunError: a file cannot be written.
    """
    scene = run.load_scene()
    folder = run.folder.path / "renders" / split
    if split == "path":
        cameras = orbit([view.cameras[0] for view in scene.train], frames)
        for name, has in (("rgb", scene.has_rgb), ("thermal", scene.has_thermal)):
            if has:
                write_frames(folder, name, _path_frames(run, cameras, name, palette, progress))
        return folder
    views = scene.eval if split == "eval" else scene.train
    if not views:
        raise ConfigError(f"{run.facts.scene}: no views are held out; choose --split train or --split path")
    for number, view in enumerate(views, start=1):
        write_rendering(folder, view.name, render_view(run.model, view), run.temperature, palette)
        if progress is not None:
            progress(number, len(views))
    return folder


def _path_frames(
    run: Run, cameras: list[Camera], modality: str, palette: PaletteName, progress: Progress | None
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """The frames of one modality along a camera path, one at a time."""
    for number, camera in enumerate(cameras, start=1):
        with torch.no_grad():
            rendering, _ = render(run.model, *((camera, None) if modality == "rgb" else (None, camera)))
        yield _picture(rendering, run, palette)
        if progress is not None:
            progress(number, len(cameras))


def _picture(rendering: Rendering, run: Run, palette: PaletteName) -> UInt8[np.ndarray, "h w 3"]:
    if rendering.rgb is not None:
        return to_rgb8(rendering.rgb)
    assert rendering.thermal is not None
    values, scale = thermal_values(rendering.thermal, run.temperature, palette)
    return colorize(values, scale.low, scale.high, scale.palette)
