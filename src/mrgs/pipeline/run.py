"""From photos, or a scene, to a model, its scores, images, report, page and exports."""

from __future__ import annotations

import math
import os
import time
from dataclasses import dataclass, replace
from pathlib import Path

from mrgs.errors import ConfigError, MrgsError, RunError, SceneError
from mrgs.export.points import require_laspy
from mrgs.kernels.cache import are_compiled
from mrgs.pipeline.forecast import Forecast, Workload, pace_so_far, size_in_training, stage_parts
from mrgs.pipeline.plan import (
    QUALITIES,
    Intake,
    Monitor,
    PipelinePlan,
    PlannedStage,
    Quality,
    take_in,
)
from mrgs.pipeline.stages import LEDGER, Job
from mrgs.prepare.options import PrepareOptions
from mrgs.prepare.sfm.reconstruct import require_pycolmap
from mrgs.run_files.folder import CHECKPOINTS_KEPT, RunFolder
from mrgs.scene import THERMAL
from mrgs.system import gpu
from mrgs.system.atomic import LOCK
from mrgs.system.disk import free_disk
from mrgs.system.gpu import HOST, DeviceName
from mrgs.system.memory import free_memory
from mrgs.system.threads import available_cores
from mrgs.training.memory import checkpoint_bytes, training_bytes
from mrgs.training.photos import bytes_per_pixel

COMPILING_S = 45.0
"""Processor seconds to compile the kernels of a method with heads (docs/performance.md)."""

CACHED_SHARE = 0.01
"""Share of the time to prepare photos that is needed if all results are in the cache."""


@dataclass(frozen=True)
class PipelineResults:
    """The files that a pipeline made: ``run`` is the folder of the model, which ``load_run`` opens,
    and ``contact_sheet`` has photos beside renderings; None if no views are held out."""

    scene: Path
    scene_page: Path
    run: Path
    report: Path
    page: Path
    contact_sheet: Path | None
    renders: Path
    exports: Path


def run_pipeline(
    source: str | Path,
    output: str | Path | None = None,
    *,
    quality: str = "default",
    options: PrepareOptions | None = None,
    device: DeviceName = "auto",
    monitor: Monitor | None = None,
    flat_field: Path | None = None,
) -> PipelineResults:
    """Prepare, train, score, render, report, page, exports; the same call resumes after an
    interruption, and repeats only stages whose inputs or settings have changed.

    Args:
        source: folder of photos, or of a scene; it is only read.
        output: folder of all results; by default ``default_output``, beside the source.
        quality: how much work is put into the model: "fast", "default" or "best".
        options: facts about the photos.
        device: where it is trained and rendered.
        monitor: follows the progress, and accepts warnings; by default nothing is accepted.
        flat_field: folder of thermal photos of a uniform target, which show how the camera shades
            its photos, in the same unit; None to find that from the overlap of the photos.

    Raises:
        SceneError: the photos or the scene cannot be used, or warnings about them were not
            accepted.
        ConfigError: an option that does not fit the photos, or an extra that is not installed.
        RunError: a folder cannot be written or is in use, or the disk has too little space.
        DeviceError: the GPU was asked for and cannot be used.
        TrainingError: the training failed.
        KeyboardInterrupt: the monitor stopped the training; the same call resumes it.
    """
    if quality not in QUALITIES:
        raise ConfigError(f"unknown quality {quality!r}; choose one of {', '.join(QUALITIES)}")
    monitor = monitor or Monitor()
    source, used = Path(source), gpu.choose_device(device)
    intake, options = _taken_in(source, options or PrepareOptions(), monitor)
    unit = options.overrides.unit
    chosen = replace(QUALITIES[quality], flat_field=flat_field, flat_field_unit=unit)
    target = (default_output(source, options) if output is None else Path(output)).absolute()
    _require_own(source, target)
    if intake.kind == "photos" and options.poses is None:
        require_pycolmap()
    notes = []
    try:
        require_laspy()
    except ConfigError as error:
        notes.append(f"the export las is left out: {error}")
    compiling_s = COMPILING_S if used == HOST and not are_compiled() else 0.0
    work = Workload.of(intake, chosen, compiling_s)
    disk = disk_bytes(work, intake, chosen)
    _require_disk(disk, target)
    memory, free = needed_memory(work, intake, chosen), free_memory()
    if used == HOST and free is not None and memory > free:
        notes.append(
            f"training needs about {memory / 1e9:.1f} GB of memory, and {free / 1e9:.1f} GB are "
            f"free: close other programs, or choose a lower quality"
        )
    with RunFolder(target).locked():
        job = Job(intake, chosen, options, target, device, monitor)
        job.ledger.open()
        stages, title = _planned(job, work), gpu.device_title(used)
        plan = PipelinePlan(
            intake, chosen, available_cores(), free, title, target, stages, memory, disk,
            tuple(notes),
        )  # fmt: skip
        monitor.planned(plan)
        if not plan.stages[0].is_done:
            _require_celsius(job)
        _run_stages(job, plan, monitor)
    return _results(job)


def default_output(source: Path, options: PrepareOptions) -> Path:
    """The folder of a source's results: beside it, with its name and that of a chosen camera."""
    folder = (source.parent if source.is_file() else source).resolve()
    return folder.parent / f"{options.name_of(folder)}-mrgs"


def _taken_in(
    source: Path, options: PrepareOptions, monitor: Monitor
) -> tuple[Intake, PrepareOptions]:
    """The contents of the folder, and the options, completed by the monitor where the photos lack
    what their values mean."""
    if (source / LEDGER).is_file():
        raise RunError(
            f"{source} holds the results of an earlier run; give the folder of the photos"
        )

    def report(step: str, done: int, total: int) -> None:
        monitor.progress(f"photos: {step}", done, total, None)

    try:
        return take_in(source, options, report), options
    except MrgsError as error:
        if (completed := monitor.answer(error, options)) is None:
            raise
    return _taken_in(source, completed, monitor)


def _require_own(source: Path, output: Path) -> None:
    """Check that the folder of the results is new, or an earlier pipeline's; RunError if it is the
    source, or has something else in it."""
    own, problem = output.resolve(), ""
    try:
        if own.is_relative_to(source.resolve()):
            problem = "lies in the folder of the photos: choose another folder"
        elif own.is_dir() and not (own / LEDGER).is_file() and set(os.listdir(own)) - {LOCK}:
            problem = "holds something else: choose a new folder"
    except OSError as error:
        problem = f"cannot be read ({error.strerror}): choose another folder"
    if problem:
        raise RunError(f"{output} {problem}", options=("output",))


def _require_disk(needed: int, output: Path) -> None:
    """Check that the results fit on the disk, beside those of an earlier call; RunError if not."""
    written = sum(path.stat().st_size for path in output.rglob("*") if path.is_file())
    free = free_disk(output)
    if free < needed - written:
        raise RunError(
            f"{output}: the results need about {(needed - written) / 1e9:.1f} GB, and "
            f"{free / 1e9:.1f} GB are free; make room, or choose a folder on another disk",
            options=("output",),
        )


def disk_bytes(work: Workload, intake: Intake, quality: Quality) -> int:
    """Bytes that a pipeline writes, roughly: the scene, checkpoints and the one that is being
    written, renderings, exports."""
    scene = 0
    if work.photos:
        thermal_px = math.prod(intake.sizes.get(THERMAL, (0, 0)))
        scene = intake.bytes + (4 * thermal_px + 1_000_000) * work.views
    checkpoint = checkpoint_bytes(quality.config(), intake.sizes, work.gaussians)
    model = (CHECKPOINTS_KEPT + 1) * checkpoint + 1_500 * work.gaussians
    images = int(1e3 * work.kpx) * (12 * (work.held_out or work.views) + 2 * work.views)
    return int(1.2 * (scene + model + images)) + 50_000_000


def needed_memory(work: Workload, intake: Intake, quality: Quality) -> int:
    """Bytes of memory that training needs at most, roughly."""
    bytes_each = sum(
        bytes_per_pixel(modality) * math.prod(size_in_training(size, quality.resolution))
        for modality, size in intake.sizes.items()
    )
    return training_bytes(
        quality.config(),
        intake.sizes,
        work.gaussians,
        pixels=round(1e3 * work.kpx),
        photo_bytes=bytes_each * (work.views - work.held_out),
        compiles=work.compiles_s > 0,
    )


def _planned(job: Job, work: Workload) -> tuple[PlannedStage, ...]:
    stages, done, planned = job.stages, True, []
    expected = stage_parts(work).items()
    for number, (stage, (name, parts)) in enumerate(zip(stages, expected, strict=True), 1):
        done = done and job.ledger.is_done(stage.name, stage.made_from)
        is_first = number == 1 and job.intake.kind == "photos"
        if not done and is_first and job.ledger.is_begun(stage.name, stage.made_from):
            # An earlier call has prepared these photos, and only stopped at its warnings.
            parts = {part: CACHED_SHARE * seconds for part, seconds in parts.items()}
        planned.append(PlannedStage(name, number, len(stages), parts, done))
    return tuple(planned)


def _require_celsius(job: Job) -> None:
    """Stop before poses are computed if the photos lack °C; SceneError unless accepted."""
    if not (why := job.intake.without_celsius):
        return
    text = f"the model would have no °C. {why} Give the camera's radiometric files"
    options = ("bounds_c",) if job.intake.takes_bounds else ()
    if options:
        text += ", or give the °C of black and white, if all photos share that span"
    if not job.monitor.accepts_relative(SceneError(text, options=options)):
        text += "; or run again and accept relative values"
        raise SceneError(text, options=(*options, "yes"))
    job.accepted = why


def _run_stages(job: Job, plan: PipelinePlan, monitor: Monitor) -> None:
    """Run what is not done; what one stage changes, the following depend on."""
    expected = taken = 0.0
    whole = sum(planned.seconds for planned in plan.stages)
    for stage, planned in zip(job.stages, plan.stages, strict=True):
        if job.ledger.is_done(stage.name, stage.made_from):
            monitor.reused(planned)
            continue
        pace = pace_so_far(taken, expected, whole)
        rest_s = pace * sum(each.seconds for each in plan.stages[planned.number :])
        started, made_from = time.perf_counter(), stage.made_from()
        parts = {name: pace * seconds for name, seconds in planned.parts.items()}
        forecast = Forecast(parts)

        def report(text: str, done: int, total: int, forecast: Forecast = forecast) -> None:
            left_s = forecast.left(text, done / total if total else None)
            monitor.progress(text, done, total, left_s)

        with monitor.running(replace(planned, parts=parts), rest_s):
            files = stage.run(report)
        job.ledger.finish(stage.name, made_from, files)
        if planned.number > 1:  # the first may wait for an answer, or find its results in a cache
            expected += sum(planned.parts.values())
            taken += time.perf_counter() - started


def _results(job: Job) -> PipelineResults:
    model = job.model
    sheet = model / "eval" / "contact_sheet.png"
    photos = job.intake.kind == "photos"
    return PipelineResults(
        scene=job.scene,
        scene_page=job.scene / "prepare.html" if photos else job.output / "check.html",
        run=model,
        report=model / "report.html",
        page=model / "export" / "page.html",
        contact_sheet=sheet if sheet.is_file() else None,
        renders=model / "renders",
        exports=model / "export",
    )
