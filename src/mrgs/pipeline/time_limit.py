"""How many steps a training may take that has to end in a given time, from the pace of its first
steps."""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from mrgs.method.config import TrainConfig
from mrgs.pipeline.forecast import mean_gaussians, mean_kpx, step_seconds
from mrgs.runs.registry import Method
from mrgs.scene import Scene
from mrgs.training.start import DEFAULT_OPTIONS, Hooks, TrainOptions

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
        step_s: a step.
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
    also compiles the kernels.

    Raises:
        MrgsError: what the training itself would raise.
    """
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
    at least one.

    A step takes longer once there are more Gaussians, and less time while photos are coarse, by the
    model of a pipeline's training.
    """
    growth = 1.0
    if max_gaussians is not None and pace.gaussians:
        mean = mean_gaussians(pace.gaussians, max(max_gaussians, pace.gaussians))
        growth = step_seconds(mean, pace.mean_kpx) / step_seconds(pace.gaussians, pace.kpx)
    return max(1, int((seconds - pace.loading_s) / (MARGIN * growth * pace.step_s)))
