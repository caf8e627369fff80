"""How long work takes: expected lengths, linear in what is worked on, corrected by the measured
pace; and how many steps a training that has to end in a given time may take. The coefficients are
seconds on one core of a server of 2024 (decision 029)."""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from mrgs.errors import MrgsError
from mrgs.export.page.write import MOST_PHOTOS
from mrgs.export.write import BAKING
from mrgs.method.config import TrainConfig
from mrgs.pipeline.plan import QUALITIES, Intake, Quality, Size, take_in
from mrgs.prepare.contract import Progress
from mrgs.prepare.options import PrepareOptions
from mrgs.runs.open import Run
from mrgs.runs.registry import Method
from mrgs.scene import Scene
from mrgs.system.threads import available_cores
from mrgs.training.start import DEFAULT_OPTIONS, Hooks, TrainOptions
from mrgs.training.view_pass import coarse_size

PARALLEL = 0.5
"""Share of the work that is spread over the cores (Amdahl)."""

MATURE = 0.3
"""Share of the steps after which a model has reached its cap on the Gaussians."""

TRUST = 0.1
"""Share of the whole work after which the measured pace counts as much as the expected one."""

ALMOST_DONE = 0.95
"""Largest assumed share of a part whose progress is not known."""


@dataclass(frozen=True)
class Workload:
    """What the lengths of the stages depend on.

    Attributes:
        held_out: of these, the views that are scored.
        source_px: pixels of a view's images as they are.
        kpx: thousands of pixels of a view's images in training, at their full resolution.
        mean_kpx: the same as a mean over the steps, of which the first are coarser.
        start: Gaussians at the start.
        gaussians: Gaussians at the end.
        photos: whether the scene is made from photos.
        finds_poses: whether their poses must be found.
        has_two_cameras: whether a thermal camera must be placed.
    """

    views: int
    held_out: int
    source_px: int
    kpx: float
    mean_kpx: float
    start: int
    gaussians: int
    steps: int
    photos: bool = False
    finds_poses: bool = False
    has_two_cameras: bool = False
    compiles_s: float = 0.0

    @classmethod
    def of(cls, intake: Intake, quality: Quality, compiles_s: float = 0.0) -> Workload:
        """The workload of photos or a scene at a quality."""
        sizes = [size_in_training(size, quality.resolution) for size in intake.sizes.values()]
        start = 450 * intake.views if intake.points is None else intake.points
        photos = intake.kind == "photos"
        return cls(
            views=intake.views,
            held_out=intake.held_out,
            source_px=sum(map(math.prod, intake.sizes.values())),
            kpx=sum(map(math.prod, sizes)) / 1e3,
            mean_kpx=mean_kpx(sizes, quality.config()),
            start=min(start, quality.max_gaussians),
            gaussians=quality.max_gaussians,
            steps=quality.max_steps,
            photos=photos,
            finds_poses=photos and not intake.poses_given,
            has_two_cameras=len(intake.sizes) > 1,
            compiles_s=compiles_s,
        )

    @classmethod
    def of_run(cls, run: Run, scene: Scene) -> Workload:
        """The workload of a trained model."""
        pixels = sum(camera.width * camera.height for camera in scene.train[0].cameras.values())
        views, held_out = len(scene.train) + len(scene.eval), len(scene.eval)
        kpx, gaussians = pixels / 1e3, run.gaussian_count
        return cls(views, held_out, pixels, kpx, kpx, gaussians, gaussians, run.config.max_steps)


def size_in_training(size: Size, resolution: int) -> Size:
    """The size of an image in training, at its full resolution."""
    scale = min(1.0, resolution / size[0])
    return round(scale * size[0]), max(1, round(scale * size[1]))


def mean_kpx(sizes: Sequence[Size], config: TrainConfig) -> float:
    """Thousands of pixels of images of these sizes, as a mean over the steps of a training."""
    shares = Counter(config.pixel_size_at(step) for step in range(1, config.max_steps + 1))
    return sum(
        count / config.max_steps * math.prod(coarse_size(*size, pixel_size)) / 1e3
        for pixel_size, count in shares.items()
        for size in sizes
    )


def mean_gaussians(start: int, most: int) -> float:
    """Mean number of Gaussians over a training: a ramp from the start to the cap, then the cap."""
    return MATURE * (start + most) / 2 + (1 - MATURE) * most


def step_seconds(gaussians: float, kpx: float) -> float:
    """Length of a training step with thousands of pixels of images."""
    return 0.014 + 1.55e-6 * gaussians + 0.2e-3 * kpx


def stage_parts(work: Workload, cores: int | None = None) -> dict[str, dict[str, float]]:
    """Seconds of the parts of each stage, by name, in order; on all available cores by default."""
    views, held_out, kpx, million = work.views, work.held_out, work.kpx, work.gaussians / 1e6
    render = 0.004 + 0.6 * million + 0.06e-3 * kpx
    surface = views * (render + 0.1e-3 * kpx)
    step = step_seconds(mean_gaussians(work.start, work.gaussians), work.mean_kpx)
    baking = 0.5 + 0.002 * views + 2 * held_out * render
    stages = {
        "prepare" if work.photos else "check": _prepare_parts(work),
        "train": {"compiling": 3 + work.compiles_s, "steps": step * work.steps},
        "score": {"scoring": 1 + held_out * (8 * render + 0.2e-3 * kpx)},
        "render": {"rendering": (held_out or views) * (render + 0.5e-3 * kpx)},
        "report": {
            "hottest and coldest places": 1 + surface + views * render,
            "measurements and pictures": 5 + 3 * surface,
            "page": 1,
        },
        "page": {BAKING: baking, "page": 0.5 + min(views, MOST_PHOTOS) * 0.3e-3 * kpx},
        "exports": {
            BAKING: baking,
            **dict.fromkeys(("ply", "spz", "glb"), 10 * million),
            "points": surface,
            "las": 50 * million,
            "mesh": 3 + 3 * surface,
            "cameras": views * (0.005 + 0.2e-3 * kpx),
            "ortho": 1 + 3 * surface,
            **dict.fromkeys(("elevation", "marks"), 1 + surface),
        },
    }
    share = 1 - PARALLEL + PARALLEL / (cores or available_cores())
    return {
        name: {part: share * seconds for part, seconds in parts.items()}
        for name, parts in stages.items()
    }


def _prepare_parts(work: Workload) -> dict[str, float]:
    """Parts of the first stage; a part is a title, or "title: step", as ``prepare`` reports it."""
    views = work.views
    reading = views * (0.02 + 0.04e-6 * work.source_px)
    if not work.photos:
        return {"reading images": reading}
    parts = {"pairs": 0.1 + 0.005 * views, "images": reading}
    if work.finds_poses:
        pairs = min(views * (views - 1) / 2, max(30 * views, 4950))
        parts["poses: features"] = 1.5e-6 * min(work.source_px, 1600 * 1200) * views
        parts["poses: matching"] = 0.12 * pairs
        parts["poses: mapping"] = 0.35 * views
    if work.has_two_cameras:
        parts["thermal camera: reading pairs"] = 0.25 * views
        parts["thermal camera: matching"] = 0.65 * views
    return {**parts, "page": 2 + 0.02 * views}


def pace_so_far(taken: float, expected: float, whole: float) -> float:
    """Measured seconds per expected second, drawn towards 1 while little is done."""
    trust = TRUST * whole
    return (taken + trust) / (expected + trust) if expected + trust > 0 else 1.0


class Forecast:
    """Time left of parts that are done one after another, from their expected lengths in seconds,
    by name, and the pace so far."""

    def __init__(
        self, parts: Mapping[str, float], clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._parts, self._whole = parts, sum(parts.values())
        self._clock, self._part = clock, ""
        self._started = self._part_started = clock()

    def left(self, text: str, share: float | None = None) -> float | None:
        """Seconds left; None for an unknown part."""
        part = text if text in self._parts else text.partition(": ")[0]
        if part not in self._parts:
            return None
        now = self._clock()
        if part != self._part:
            self._part, self._part_started = part, now
        names, length = [*self._parts], self._parts[part]
        before = sum(self._parts[name] for name in names[: names.index(part)])
        if share is None:
            pace = self._pace(before, self._part_started)
            elapsed = now - self._part_started
            share = min(elapsed / (pace * length), ALMOST_DONE) if length > 0 else 0.0
        done = before + share * length
        return self._pace(done, now) * (self._whole - done)

    def _pace(self, done: float, now: float) -> float:
        return pace_so_far(now - self._started, done, self._whole)


def expect_prepare(
    photos: Path, options: PrepareOptions, progress: Progress | None = None
) -> Forecast | None:
    """Forecast of ``mrgs prepare`` of a folder of photos; None for photos that cannot be used,
    which it reports itself. The progress is called with "pairs: step", the number of files that are
    done, and of all files."""

    def report(step: str, done: int, total: int) -> None:
        if progress is not None:
            progress(f"pairs: {step}", done, total)

    try:
        intake = take_in(photos, options, report)
    except MrgsError:
        return None
    parts = stage_parts(Workload.of(intake, QUALITIES["fast"]))
    return Forecast(parts["prepare"]) if "prepare" in parts else None


def expect_export(run: Run, scene: Scene, format: str) -> Forecast:
    """Forecast of ``mrgs export`` of one format, or of "all"."""
    stages = stage_parts(Workload.of_run(run, scene))
    parts = stages["exports"] | stages["page"]
    if format != "all":
        parts = {name: seconds for name, seconds in parts.items() if name in (BAKING, format)}
    return Forecast(parts)


def expect_report(run: Run, scene: Scene) -> Forecast:
    """Forecast of ``mrgs report``."""
    return Forecast(stage_parts(Workload.of_run(run, scene))["report"])


PILOT_S = 3.0
"""How long the steps of a pilot take at least."""

PILOT_STEPS = 12
"""Steps of a pilot at least; the first third is not counted: caches are cold, photos are read."""

MARGIN = 1.05
"""Checkpoints, densifications, and the last picture of a viewer."""


class Pace(NamedTuple):
    """What a pilot found.

    Attributes:
        loading_s: from the call to the first step, without compiling.
        gaussians: N; None for a method without Gaussians.
        kpx: thousands of pixels of a view's images, at their full resolution.
        mean_kpx: the same as a mean over the steps of the training, of which the first are coarser.
    """

    loading_s: float
    step_s: float
    gaussians: int | None
    kpx: float
    mean_kpx: float


def measure_pace(
    method: Method,
    scene: str | Path,
    config: Any,
    options: TrainOptions = DEFAULT_OPTIONS,
    clock: Callable[[], float] = time.perf_counter,
) -> Pace:
    """Train for a few seconds into a folder that is thrown away, on photos of full resolution; this
    also compiles the kernels. Errors are those of the training."""
    found: dict[str, Any] = {}
    called = clock()
    times = [called]

    def on_start(loaded: Scene, _: Any) -> None:
        times[0] = clock()
        cameras = [camera for view in loaded.train for camera in view.cameras.values()]
        sizes, views = [(camera.width, camera.height) for camera in cameras], len(loaded.train)
        found["kpx"] = found["mean_kpx"] = sum(map(math.prod, sizes)) / views / 1e3
        if isinstance(config, TrainConfig):
            found["mean_kpx"] = mean_kpx(sizes, config) / views

    def on_step(step: Any) -> bool:
        times.append(clock())
        found["gaussians"] = step.gaussians
        return len(times) > PILOT_STEPS and times[-1] - times[1] > PILOT_S

    sharp = replace(config, coarse_until=0.0) if isinstance(config, TrainConfig) else config
    with tempfile.TemporaryDirectory(prefix="mrgs-") as folder:
        pilot = Path(folder, "run")
        method.train(scene, pilot, sharp, options, Hooks(on_step, on_start))
    steps = [after - before for before, after in pairwise(times[len(times) // 3 :])]
    return Pace(times[0] - called, statistics.median(steps), **found)


def steps_within(seconds: float, pace: Pace, max_gaussians: int | None) -> int:
    """The steps that fit into a time from the start of a training with this cap on the Gaussians,
    at least one, by the model of a pipeline's training: more Gaussians take longer, coarse photos
    less."""
    growth = 1.0
    if max_gaussians is not None and pace.gaussians:
        mean = mean_gaussians(pace.gaussians, max(max_gaussians, pace.gaussians))
        growth = step_seconds(mean, pace.mean_kpx) / step_seconds(pace.gaussians, pace.kpx)
    return max(1, int((seconds - pace.loading_s) / (MARGIN * growth * pace.step_s)))
