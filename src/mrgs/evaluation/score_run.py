"""Score a run and write its pictures, as ``mrgs eval`` and ``mrgs render`` do."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal, TypeAlias, get_args

from mrgs.errors import ConfigError, SceneError, warn_user
from mrgs.evaluation.contact_sheet import SheetRows, ViewImages, contact_sheet
from mrgs.evaluation.evaluate import Metrics, ViewMetrics, Visitor, evaluate
from mrgs.evaluation.held_out_poses import (
    NOT_KNOWN,
    HeldOutPoses,
    aligned_view,
    held_out_error,
    looked_at_first,
)
from mrgs.evaluation.lpips import Lpips
from mrgs.evaluation.parts import Parts, score_parts
from mrgs.evaluation.report import RunFacts, ScoredData, write_report
from mrgs.evaluation.truth import Truth
from mrgs.pictures.files import to_picture, write_png, write_rendering
from mrgs.pictures.palette import PaletteName
from mrgs.pictures.video import frame_writer
from mrgs.runs.open import Run, TrainedRun
from mrgs.scene import Camera, CameraResponse, Rendering, Scene, View, ideal_cameras
from mrgs.scene.camera_paths import orbit
from mrgs.system.memory import give_back_freed

PATH_FRAMES = 120

Split: TypeAlias = Literal["eval", "train", "path"]
"""The held-out views, those that were trained on, or a camera path around the scene."""

Progress = Callable[[int, int], None]
"""Called with the number of images done and of all images."""


def evaluate_run(
    run: TrainedRun, lpips_weights: Path | None = None, progress: Progress | None = None
) -> Metrics:
    """Score the run on its scene's eval views.

    Writes ``metrics.json``, ``metrics.md`` and ``contact_sheet.png`` into the run's folder
    ``eval``.

    Args:
        run: what ``load_run`` or ``open_run`` returns.
        lpips_weights: weights for LPIPS; without them it is left out, with the reason.
        progress: called with finished and all steps: a view is inspected, and scored. There are
            more steps if the poses turn out to be wrong.

    Raises:
        SceneError: the scene cannot be read, or has no eval views.
        RunError: the weights cannot be read, or a file cannot be written.
    """
    scene = run.load_scene()
    truth = Truth.of(scene)
    counted = Counted(progress, len(scene.eval) + len(looked_at_first(scene.eval)))
    poses = _held_out_poses(run, scene, counted)
    views = poses.aligned or scene.eval
    parts = score_parts(run, views, truth) if isinstance(run, Run) and views else None
    return score_views(
        scene,
        truth,
        run.render_view,
        facts_of(run, scene),
        run.folder.path / "eval",
        lpips_weights,
        counted.one_more,
        run.camera_response,
        parts,
        ScoredData.of(scene, run.facts.images),
        poses,
    )


class Counted:
    """Counts the views that are inspected, aligned or scored."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._done, self.total = progress, 0, total

    def one_more(self) -> None:
        """A view is done."""
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self.total)


def _held_out_poses(run: TrainedRun, scene: Scene, counted: Counted) -> HeldOutPoses:
    """The poses of the held-out views, checked, and corrected where they are wrong.

    Warns:
        MrgsWarning: they are wrong.
    """
    error = held_out_error(run, looked_at_first(scene.eval), counted.one_more)
    if error is None or not error.found.is_wrong:
        return HeldOutPoses(None if error is None else error.photo_px)
    warn_user(
        f"{scene.name}: the held-out photos are about {error.photo_px:.1f} pixels off what the "
        f"model shows: poses, theirs or those trained on, seem to be wrong, so they are scored "
        f"with aligned poses as well"
    )
    counted.total += 2 * len(scene.eval)
    aligned = []
    for view in scene.eval:
        aligned.append(aligned_view(run, view))
        counted.one_more()
    return HeldOutPoses(error.photo_px, tuple(aligned))


def score_views(
    scene: Scene,
    truth: Truth | None,
    render: Callable[[View], Rendering],
    facts: RunFacts,
    output: Path,
    lpips_weights: Path | None = None,
    on_view: Callable[[], None] = lambda: None,
    camera_response: CameraResponse = ideal_cameras,
    parts: Parts | None = None,
    data: ScoredData | None = None,
    poses: HeldOutPoses = NOT_KNOWN,
) -> Metrics:
    """Score renderings of a scene's eval views, and write the scores and the contact sheet into a
    folder.

    Args:
        scene: with eval views.
        truth: the scene's exact truth; None if there is none.
        render: from a view to its images.
        facts: of the run, for the report.
        output: folder to write to.
        lpips_weights: weights for LPIPS; without them it is missing, with the reason.
        on_view: called after each view.
        camera_response: from a rendering to what the cameras record, which the photos show.
        parts: for the report; None if the model has none.
        data: of the scores, for the report; None for another program's renderings.
        poses: of the eval views; aligned ones are scored too, and shown on the contact sheet.

    Raises:
        SceneError: the scene has no eval views, or an image cannot be read.
        RunError: the weights cannot be read, or a file cannot be written.
    """
    if not scene.eval:
        remedy = (
            "put 'eval' into the file names of some, or list them in val_filenames"
            if scene.path
            else "make the scene with eval_every=8, or another number of 2 or more"
        )
        raise SceneError(
            f"{scene.path or scene.name}: no views are held out, so there is nothing to score; "
            f"{remedy}, and retrain"
        )
    lpips = None if lpips_weights is None else Lpips.from_file(lpips_weights)
    shown = SheetRows(len(scene.eval))
    score = partial(
        evaluate,
        render=render,
        temperature=scene.temperature,
        lpips=lpips,
        truth=truth,
        camera_response=camera_response,
    )
    visit = _visitor(scene, shown, on_view)
    if poses.aligned is None:
        metrics = score(scene.eval, visit=visit)
    else:
        given = score(scene.eval, visit=lambda *_: on_view())
        metrics = replace(given, aligned=score(poses.aligned, visit=visit))
    metrics = replace(metrics, pose_error_px=poses.error_px)
    write_report(output, facts, metrics, parts, data)
    write_png(
        output / "contact_sheet.png", contact_sheet(shown.rows, facts, metrics, scene.temperature)
    )
    return metrics


def _visitor(scene: Scene, shown: SheetRows, on_view: Callable[[], None]) -> Visitor:
    """Collects the rows of the contact sheet, and reports the progress."""
    ball, numbers = scene.reach, itertools.count()

    def visit(view: View, rendering: Rendering, metrics: ViewMetrics) -> None:
        shown.add(
            next(numbers),
            metrics,
            lambda: ViewImages.of(view, rendering, scene.temperature, ball),
        )
        on_view()

    return visit


def facts_of(run: TrainedRun, scene: Scene) -> RunFacts:
    """Facts about a run for its report: method, scene, size and cost."""
    return RunFacts(
        method=run.config.method,
        scene=scene.name,
        steps=run.facts.step,
        gaussians=run.gaussian_count,
        train_seconds=run.facts.train_seconds,
        peak_memory_bytes=run.facts.peak_memory_bytes or None,
        device=run.facts.device,
    )


def render_run(
    run: TrainedRun,
    split: Split = "eval",
    palette: PaletteName = "inferno",
    frames: int = PATH_FRAMES,
    progress: Progress | None = None,
) -> Path:
    """Write the run's images of a split into the run's folder ``renders/SPLIT``; returns that
    folder.

    Per view: what ``write_rendering`` writes. For ``path``, a camera path around the scene: frames
    of each modality as PNG, and as mp4 where the extra ``video`` is installed.

    Raises:
        SceneError: the scene cannot be read.
        ConfigError: an unknown split, or one without views.
        RunError: a file cannot be written.
    """
    if split not in get_args(Split):
        raise ConfigError(
            f"unknown split {split!r}; choose one of {', '.join(get_args(Split))}",
            options=("split",),
        )
    scene = run.load_scene()
    folder = run.folder.path / "renders" / split
    if split == "path":
        cameras = orbit(scene.train_cameras, frames)
        _write_path(run, scene, cameras, folder, palette, progress)
        return folder
    views = scene.eval if split == "eval" else scene.train
    if not views:
        raise ConfigError(
            f"{scene.path or scene.name}: no views are held out; choose the split train or path",
            options=("split",),
        )
    ball = scene.reach
    for number, view in enumerate(views, start=1):
        write_rendering(folder, view, run.render_view(view), run.temperature, palette, ball)
        give_back_freed()  # else each view leaves gaps of some MB, and there may be hundreds
        if progress is not None:
            progress(number, len(views))
    return folder


def _write_path(
    run: TrainedRun,
    scene: Scene,
    cameras: list[Camera],
    folder: Path,
    palette: PaletteName,
    progress: Progress | None,
) -> None:
    """The frames of each modality along a camera path, each camera rendered once."""
    size = (cameras[0].width, cameras[0].height)
    with ExitStack() as stack:
        writers = {
            modality: stack.enter_context(frame_writer(folder, modality.name, size))
            for modality in scene.modalities
            if modality in run.modalities
        }
        for number, camera in enumerate(cameras, start=1):
            rendering = run.render(dict.fromkeys(writers, camera))
            for modality, add in writers.items():
                image = rendering[modality].image
                add(to_picture(modality, image, run.temperature, palette))
            give_back_freed()
            if progress is not None:
                progress(number, len(cameras))
