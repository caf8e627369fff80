"""Trains one case: ``python -m benchmarks.growth.child REQUEST``, started by ``__main__``."""

from __future__ import annotations

import os
import statistics
import time
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from benchmarks.growth.plan import Case, case_from_json
from benchmarks.growth.wall import write_wall
from benchmarks.memory import peak_bytes, reset_peak
from mrgs.kernels.cache import are_compiled
from mrgs.scene import Scene
from mrgs.system.child import read_request, send, when_asked_to_stop
from mrgs.training import Hooks, TrainConfig, estimate_bytes, train

UNTIMED = 3
"""Steps at the beginning that are not timed: they import and compile."""


def result_of(case: Case) -> dict[str, Any]:
    """Processor seconds before the first step and of a step (median), the peak of the memory and
    what was estimated of it, in bytes."""
    ends: list[float] = []
    estimates: list[int] = []

    def on_start(scene: Scene, config: TrainConfig) -> None:
        estimates.append(estimate_bytes(scene, config, case.gaussians, compiles=compiles))

    def on_step(statistics: Any) -> None:
        assert statistics.gaussians == case.gaussians, statistics.gaussians
        ends.append(time.process_time())

    config = case.config()
    compiles = not are_compiled()
    with TemporaryDirectory() as folder:
        scene = write_wall(Path(folder) / "wall", case)
        reset_peak()
        started = time.process_time()
        train(scene, Path(folder) / "run", config, hooks=Hooks(on_step, on_start))
    steps = [after - before for before, after in pairwise(ends)]
    return {
        "start_s": ends[0] - started,
        "step_s": statistics.median(steps[UNTIMED - 1 :]),
        "peak_bytes": peak_bytes(),
        "estimated_bytes": estimates[0],
    }


def main() -> None:
    """Train the case of the request, and send the result."""
    when_asked_to_stop(lambda: os._exit(1))
    request = read_request()
    case = case_from_json(request["case"])
    torch.set_num_threads(case.threads)
    send(end="done", result=result_of(case))


if __name__ == "__main__":
    main()
