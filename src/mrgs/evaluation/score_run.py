"""Score a run and write its pictures, as ``mrgs eval`` and ``mrgs render`` do."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from mrgs.data.undistort import reduced
from mrgs.errors import ConfigError, SceneError, warn_user
from mrgs.evaluation.contact_sheet import SheetRows, ViewImages, contact_sheet
from mrgs.evaluation.evaluate import Metrics, Parts, Truth, ViewMetrics, evaluate, score_parts
from mrgs.evaluation.held_out_poses import aligned_view, held_out_error, looked_at_first
from mrgs.evaluation.lpips import Lpips
from mrgs.evaluation.report import RunFacts, ScoredData, write_report
from mrgs.pictures.files import (
    full_scale,
    shown_values,
    to_picture,
    with_scale_bar,
    write_png,
    write_rendering,
)
from mrgs.pictures.palette import PaletteName
from mrgs.pictures.video import VIDEO_FPS, frame_writer
from mrgs.render import bake_temperature_residuals
from mrgs.run_files.folder import Pictures
from mrgs.runs.open import Run, TrainedRun
from mrgs.scene import (
    NOT_COARSER,
    Camera,
    CameraResponse,
    Modality,
    Rendering,
    Scene,
    View,
    ideal_cameras,
)
from mrgs.scene.camera import orbit
from mrgs.scene.view import evenly_spaced
from mrgs.system.gpu import HOST
from mrgs.system.memory import give_back_freed
from mrgs.system.torch_modes import own_modes
from mrgs.training.loop import Trainer


@dataclass(frozen=True)
class PathOptions:
    """How a camera path is rendered: frames, their width in pixels (by default that of the photos),
    frames per second of its films, and whether images in °C have a scale bar. ConfigError for
    values out of range."""

    frames: int = 120
    width: int | None = None
    fps: int = VIDEO_FPS
    scale_bar: bool = False

    def __post_init__(self) -> None:
        for name, least, most in (("frames", 1, 100_000), ("width", 16, 8192), ("fps", 1, 240)):
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise ConfigError(
                    f"{name} must be {least:,} to {most:,}, not {value:,}", options=(name,)
                )


Split: TypeAlias = Literal["eval", "train", "path"]
"""The held-out views, those that were trained on, or a camera path around the scene."""

Progress = Callable[[int, int], None]
"""Called with the number of images done and of all images."""

PICTURED_VIEWS, PICTURE_PX = 3, 512
"""Held-out views that TensorBoard shows during a training, and the greatest width of a picture."""


@own_modes()
def evaluate_run(
    run: TrainedRun, lpips_weights: Path | None = None, progress: Progress | None = None
) -> Metrics:
    """Score the run on its scene's eval views. LPIPS takes ``lpips_weights``, or what torch's hub
    keeps (docs/runs.md); without either it is left out, with the reason.

    Writes ``metrics.json``, ``metrics.md`` and ``contact_sheet.png`` into the run's folder
    ``eval``. The progress is called with finished and all steps: a view is inspected, and scored.
    There are more steps if the poses turn out to be wrong. SceneError if the scene cannot be read,
    or has no eval views; RunError if the weights cannot be read, or a file cannot be written."""
    scene = run.load_scene()
    truth = Truth.of(scene)
    counted = Counted(progress, len(scene.eval) + len(looked_at_first(scene.eval)))
    pose_error_px, aligned = _held_out_poses(run, scene, counted)
    views = aligned or scene.eval
    parts = score_parts(run, views, truth) if isinstance(run, Run) and views else None
    return score_views(
        scene,
        truth,
        run.render_view,
        facts_of(run, scene),
        run.folder.path / "eval",
        lpips_weights,
        counted.one_more,
        partial(_response_where_rendered, run),
        _OfRun(parts, ScoredData.of(scene, run.facts.images), pose_error_px, aligned),
    )


def _response_where_rendered(
    run: TrainedRun,
    rendering: Rendering,
    camera: Camera,
    pixel_sizes: Mapping[Modality, float] = NOT_COARSER,
) -> Rendering:
    """The run's camera response, its images on the device that renders, where they are scored."""
    observed = run.camera_response(rendering, camera, pixel_sizes)
    device = run.device if isinstance(run, Run) else HOST
    return observed.with_images({each: blend.image.to(device) for each, blend in observed.items()})


class Counted:
    """Counts the views that are inspected, aligned or scored."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._done, self.total = progress, 0, total

    def one_more(self) -> None:
        """A view is done."""
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self.total)


def _held_out_poses(
    run: TrainedRun, scene: Scene, counted: Counted
) -> tuple[float | None, tuple[View, ...] | None]:
    """How far off what the model shows a typical held-out photo is, pixels of the photo, None if
    not known; and where the poses are wrong, with a warning, the views with their photos aligned.

    At a wrong pose a sharp model scores no better than a blurred one. So such photos are aligned
    with the model and scored there as well, as is usual for learned poses (BARF, 2021)."""
    error = held_out_error(run, looked_at_first(scene.eval), counted.one_more)
    if error is None or not error.found.is_wrong:
        return None if error is None else error.photo_px, None
    warn_user(
        f"{scene.name}: the held-out photos are about {error.photo_px:.1f} pixels off what the "
        f"model shows: poses, theirs or those trained on, seem to be wrong, so they are scored "
        f"with aligned poses as well"
    )
    counted.total += 2 * len(scene.eval)
    aligned = tuple(aligned_view(run, view, counted.one_more) for view in scene.eval)
    return error.photo_px, aligned


class _OfRun(NamedTuple):
    """What the scores of a run have beside those of another program's renderings.

    Attributes:
        parts: None if the model has none.
        data: the photos and the truth that are scored against.
        pose_error_px: of the eval views, see ``Metrics``.
        aligned: the eval views with aligned poses, which are scored too, and shown on the contact
            sheet; None where the poses are right.
    """

    parts: Parts | None = None
    data: ScoredData | None = None
    pose_error_px: float | None = None
    aligned: Sequence[View] | None = None


_OF_NO_RUN = _OfRun()


def score_views(
    scene: Scene,
    truth: Truth | None,
    render: Callable[[View], Rendering],
    facts: RunFacts,
    output: Path,
    lpips_weights: Path | None = None,
    on_view: Callable[[], None] = lambda: None,
    camera_response: CameraResponse = ideal_cameras,
    of_run: _OfRun = _OF_NO_RUN,
) -> Metrics:
    """Score renderings of a scene's eval views, and write the scores and the contact sheet into a
    folder. SceneError if the scene has no eval views, or an image cannot be read; RunError if the
    weights cannot be read, or a file cannot be written.

    Args:
        truth: the scene's exact truth; None if there is none.
        lpips_weights: weights for LPIPS, if not those that torch's hub keeps.
        camera_response: from a rendering to what the cameras record, which the photos show.
        of_run: what only a run has.
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
    lpips = Lpips.found(lpips_weights)
    shown = SheetRows(len(scene.eval))
    score = partial(
        evaluate,
        render=render,
        temperature=scene.temperature,
        lpips=lpips,
        truth=truth,
        camera_response=camera_response,
    )
    ball, numbers = scene.reach, itertools.count()

    def visit(view: View, rendering: Rendering, metrics: ViewMetrics) -> None:
        images = partial(ViewImages.of, view, rendering, scene.temperature, ball)
        shown.add(next(numbers), metrics, images)
        on_view()

    if of_run.aligned is None:
        metrics = score(scene.eval, visit=visit)
    else:
        given = score(scene.eval, visit=lambda *_: on_view())
        metrics = replace(given, aligned=score(of_run.aligned, visit=visit))
    metrics = replace(metrics, pose_error_px=of_run.pose_error_px)
    write_report(output, facts, metrics, of_run.parts, of_run.data)
    write_png(
        output / "contact_sheet.png", contact_sheet(shown.rows, facts, metrics, scene.temperature)
    )
    return metrics


def score_during_training(trainer: Trainer) -> tuple[dict[str, float], Pictures]:
    """Score the held-out views with the model as it is between two steps, which leaves the training
    as it is.

    The numbers are the means that ``evaluate_run`` would find, without LPIPS:
    ``eval_MODALITY_FIGURE`` against the photos and ``eval_truth_FIGURE`` against the exact truth.
    The pictures show photo and rendering of a few views side by side. SceneError if an image or a
    truth file cannot be read; DeviceError if the GPU's memory does not suffice."""
    run, views = _run_in_training(trainer), trainer.scene.eval
    shown = {views[number].name for number in evenly_spaced(len(views), PICTURED_VIEWS)}
    pictures: dict[str, UInt8[np.ndarray, "h w 3"]] = {}

    def visit(view: View, observed: Rendering, _: ViewMetrics) -> None:
        for modality in observed if view.name in shown else ():
            both = view.images[modality].load().values, observed[modality].image.detach().cpu()
            small = [reduced(values, None, PICTURE_PX)[0] for values in both]
            drawn = [to_picture(modality, each, run.temperature, "inferno") for each in small]
            pictures[f"eval/{modality}_{view.name}"] = np.hstack(drawn)

    truth, response = Truth.of(trainer.scene), run.camera_response
    metrics = evaluate(views, run.render_view, run.temperature, None, truth, visit, response)
    groups = [*metrics.mean.items(), ("truth", metrics.truth or {})]
    numbers = {
        f"eval_{group}_{name}": figure
        for group, figures in groups
        for name, figure in figures.items()
        if isinstance(figure, float)
    }
    return numbers, pictures


def _run_in_training(trainer: Trainer) -> Run:
    """What ``load_run`` would open if the trainer wrote a checkpoint now."""
    state, model = trainer.state, replace(trainer.state.model)
    with torch.no_grad(), own_modes(state.device):
        if model.neighbours is None:  # right after a densification
            model.neighbours = model.field.neighbours_of(model.gaussians.means)
        model = bake_temperature_residuals(model)
    image_model = state.image_model
    if state.device != HOST:
        image_model = deepcopy(image_model).to(HOST)
    return Run(trainer.folder, trainer.config, trainer.facts, model, image_model, state.device)


def facts_of(run: TrainedRun, scene: Scene) -> RunFacts:
    """Facts about a run for its report: method, scene, size and cost."""
    return RunFacts(
        run.config.method,
        scene.name,
        run.facts.step,
        run.gaussian_count,
        run.facts.train_seconds,
        run.facts.peak_memory_bytes or None,
        run.facts.device,
        run.folder.custom_parts,
    )


def render_run(
    run: TrainedRun,
    split: Split = "eval",
    palette: PaletteName = "inferno",
    path: PathOptions | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write the run's images of a split into the run's folder ``renders/SPLIT``; returns that
    folder.

    Per view: what ``write_rendering`` writes. For ``path``, a camera path around the scene: frames
    of each modality as PNG, and as mp4 where the extra ``video`` is installed. SceneError if the
    scene cannot be read, ConfigError for an unknown split, or one without views, or options of a
    path where there is none, RunError if a file cannot be written."""
    if split not in get_args(Split):
        raise ConfigError(
            f"unknown split {split!r}; choose one of {', '.join(get_args(Split))}",
            options=("split",),
        )
    if path is not None and split != "path":
        raise ConfigError("frames, width and scale bar are those of a path: choose the split path")
    scene = run.load_scene()
    folder = run.folder.path / "renders" / split
    if split == "path":
        _write_path(run, scene, path or PathOptions(), folder, palette, progress)
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
    options: PathOptions,
    folder: Path,
    palette: PaletteName,
    progress: Progress | None,
) -> None:
    """The frames of each modality along a camera path, each camera rendered once."""
    cameras = orbit(scene.train_cameras, options.frames)
    if options.width is not None:
        cameras = [camera.with_width(options.width) for camera in cameras]

    def picture(modality: Modality, image: Float[Tensor, "h w c"]) -> UInt8[np.ndarray, "h w 3"]:
        if not (options.scale_bar and modality.is_metric):
            return to_picture(modality, image, run.temperature, palette)
        values = shown_values(modality, image, run.temperature)
        return np.asarray(with_scale_bar(values, full_scale(modality, run.temperature, palette)))

    with ExitStack() as stack:
        writers = {}
        for modality in scene.modalities:
            if modality in run.modalities:
                empty = torch.zeros(cameras[0].height, cameras[0].width, modality.channels)
                height, width, _ = picture(modality, empty).shape
                writer = frame_writer(folder, modality.name, (width, height), fps=options.fps)
                writers[modality] = stack.enter_context(writer)
        for number, camera in enumerate(cameras, start=1):
            rendering = run.render(dict.fromkeys(writers, camera))
            for modality, add in writers.items():
                add(picture(modality, rendering[modality].image))
            give_back_freed()
            if progress is not None:
                progress(number, len(cameras))
