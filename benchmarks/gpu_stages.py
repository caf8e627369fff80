"""The parts of the GPU benchmark: each yields its results one by one, so that what was measured is
kept."""

from __future__ import annotations

import dataclasses
import platform
import statistics
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from benchmarks import gpu_correctness, workload
from benchmarks.gpu_failure import failure
from benchmarks.gpu_plan import (
    FORWARD,
    FORWARD_BACKWARD,
    RECORDED,
    SCENE,
    TRAINED_GAUSSIANS,
    Plan,
    Size,
)
from benchmarks.gpu_timing import Clock, PeakMemory, ceilings, host_waits
from benchmarks.gpu_workload import FusedPass, RecordedPass, photos_on
from benchmarks.plan import Effort
from benchmarks.timing import Summary
from benchmarks.workload import training_state
from mrgs.evaluation.evaluate import Truth, evaluate
from mrgs.method.config import make_config
from mrgs.runs.open import load_run
from mrgs.training import StepStatistics, train
from mrgs.training.recorder import Recorder
from mrgs.training.start import Hooks, TrainOptions
from mrgs.training.step import training_step
from mrgs.training.view_pass import PhotographedView

EVALUATION_S = 40.0
"""Kept back of the training's time for the scoring."""

STEPS_MOST = 200
"""So many steps, one after the other, tell how many there are in a second."""

RERECORD_STEPS = 8
"""Enough to rehearse and record each kind of view."""

RERECORD_REPEATS = 5

Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Order:
    """What a part is asked to do: the plan, the device, until when, as ``time.time`` counts, and
    for a training the method."""

    plan: Plan
    device: torch.device
    until: float
    method: str = "mrgs"


def device_facts(order: Order) -> Iterator[Row]:
    """Name and versions, and what the device does at most."""
    row: Row = {"device": "cpu", "python": platform.python_version(), "torch": torch.__version__}
    row["date"] = time.strftime("%Y-%m-%d")
    if order.device.type == "cuda":
        import triton

        properties = torch.cuda.get_device_properties(order.device)
        row |= {
            "device": properties.name,
            "capability": f"{properties.major}.{properties.minor}",
            "multiprocessors": properties.multi_processor_count,
            "memory_bytes": properties.total_memory,
            "cuda": torch.version.cuda,
            "triton": triton.__version__,
            "driver": _driver_version(),
        }
    yield row | ceilings(Clock(order.device), order.plan.matrix)


def _driver_version() -> str:
    """Of NVIDIA's driver, as ``nvidia-smi`` says it."""
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        said = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return said.stdout.strip().splitlines()[0]


def correctness(order: Order) -> Iterator[Row]:
    """Every comparison with an oracle."""
    for finding in gpu_correctness.findings(order.device, order.plan):
        yield {**finding, "ok": gpu_correctness.ok(finding)}


def rasterizer(order: Order) -> Iterator[Row]:
    """The fused pass at every size."""
    clock = Clock(order.device)
    for size in order.plan.sizes:
        yield _sized(size, lambda size=size: _fused_pass(clock, size, order.plan))


def _fused_pass(clock: Clock, size: Size, plan: Plan) -> Row:
    fused = FusedPass(*size, clock.device)
    memory = PeakMemory(clock.device)
    fused.forward_backward()
    peak_bytes = memory.nbytes()
    runs: dict[str, Callable[[], object]] = {
        FORWARD: fused.render,
        FORWARD_BACKWARD: fused.forward_backward,
    }
    return {
        "times": _times(clock.measure(runs | _recorded(fused), plan.effort)),
        "peak_bytes": peak_bytes,
        "least_bytes": fused.least_bytes,
        "host_waits": host_waits(fused.forward_backward),
    }


def _recorded(fused: FusedPass) -> dict[str, Callable[[], object]]:
    """The pass as a recording, where there is a GPU to record."""
    on_gpu = fused.viewmat.device.type == "cuda"
    return {RECORDED: RecordedPass(fused).forward_backward} if on_gpu else {}


def beside_gsplat(order: Order) -> Iterator[Row]:
    """The fused pass and gsplat's two, in turns in one process, at every size."""
    from benchmarks.gpu_gsplat import GsplatPasses, build

    yield {"gsplat": build()}
    clock = Clock(order.device)
    for size in order.plan.sizes:
        yield _sized(size, lambda size=size: _compare(clock, size, order.plan, GsplatPasses))


def _compare(clock: Clock, size: Size, plan: Plan, make_passes: Callable[[FusedPass], Any]) -> Row:
    fused = FusedPass(*size, clock.device)
    theirs = make_passes(fused)
    ways = {"two passes": theirs.two_passes, "shared projection": theirs.shared_projection}
    forward: dict[str, Callable[[], Any]] = {"mrgs": fused.render}
    both: dict[str, Callable[[], object]] = {"mrgs": fused.forward_backward} | _recorded(fused)
    for name, way in ways.items():
        forward[name] = torch.no_grad()(way)
        both[name] = lambda way=way: theirs.gradients(way)
    images = {name: way() for name, way in forward.items()}
    return {
        "times": {
            FORWARD: _times(clock.measure(forward, plan.effort)),
            FORWARD_BACKWARD: _times(clock.measure(both, plan.effort)),
        },
        "mean_difference": {
            name: max(
                (a - b).abs().mean().item()
                for a, b in zip(images["mrgs"], images[name], strict=True)
            )
            for name in ways
        },
    }


def step(order: Order) -> Iterator[Row]:
    """Whole training steps of each method: render, losses, backward, Adam."""
    clock = Clock(order.device)
    for size in order.plan.step_sizes:
        for method in order.plan.methods:
            row = _sized(size, lambda m=method, s=size: _steps(clock, m, s, order.plan))
            yield {"method": method, **row}


def _steps(clock: Clock, method: str, size: Size, plan: Plan) -> Row:
    count, width, height = size
    config = make_config(method, "paper")
    memory = PeakMemory(clock.device)
    state = training_state(count, config, clock.device)
    photos = photos_on(clock.device, width, height)
    views = [PhotographedView(0, workload.view(width, height), photos)]
    recorder = Recorder(clock.device) if clock.device.type == "cuda" else None

    def run() -> StepStatistics:
        result = training_step(state, views, config, workload.SCALE, recorder=recorder)
        return result.statistics

    times = clock.measure({"step": run}, plan.steps, flush=False)
    rerecord_ms = (
        None if recorder is None else _rerecord_ms(clock, run, recorder, times["step"].median_ms)
    )
    return {
        "times": _times(times),
        "rerecord_ms": rerecord_ms,
        "steps_per_s": _per_second(clock, run, plan.steps),
        "peak_bytes": memory.nbytes(),
        "host_waits": host_waits(run),
    }


def _rerecord_ms(
    clock: Clock,
    run: Callable[[], object],
    recorder: Recorder,
    step_ms: float,
    now: Callable[[], float] = time.perf_counter,
) -> float:
    """Cost of re-recording everything after the Gaussians have changed, without the change."""
    found = []
    for _ in range(RERECORD_REPEATS):
        started = now()
        recorder.forget()
        for _ in range(RERECORD_STEPS):
            run()
        clock.wait()
        found.append(1e3 * (now() - started) - RERECORD_STEPS * step_ms)
    return statistics.median(found)


def _per_second(clock: Clock, run: Callable[[], object], effort: Effort) -> float:
    """Runs per second on the host's clock, with all that lies between two of them."""
    runs = 0
    started = time.perf_counter()
    while runs < min(effort.runs, STEPS_MOST):
        if runs >= effort.fewest and time.perf_counter() - started > effort.seconds:
            break
        run()
        runs += 1
    clock.wait()
    return runs / (time.perf_counter() - started)


def training(order: Order) -> Iterator[Row]:
    """The bundled scene with the paper's schedule, until its end or until the time is up; then
    scored."""
    plan, device = order.plan, order.device
    config = make_config(
        order.method,
        "paper",
        max_steps=plan.training_steps,
        resolution=plan.resolution,
        max_gaussians=TRAINED_GAUSSIANS,
    )
    clock, memory = Clock(device), PeakMemory(device)
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        last: list[StepStatistics] = []
        grown: list[float] = []

        def on_step(statistics: StepStatistics) -> bool:
            last[:] = [statistics]
            if statistics.step == config.densification.stop:
                grown.append(time.perf_counter() - started)
            return time.time() > order.until - EVALUATION_S

        with warnings.catch_warnings(record=True) as caught:
            train(
                SCENE,
                Path(folder) / "run",
                config,
                options=TrainOptions(device=device.type),
                hooks=Hooks(on_step=on_step),
            )
        clock.wait()
        seconds = time.perf_counter() - started
        yield {
            "method": order.method,
            "steps": last[0].step,
            "of_steps": config.max_steps,
            "seconds": seconds,
            "seconds_growing": grown[0] if grown else None,
            "steps_per_s": last[0].step / seconds,
            "gaussians": last[0].gaussians,
            "peak_bytes": memory.nbytes(),
            "warnings": list(dict.fromkeys(str(each.message) for each in caught)),
        }
        run = load_run(Path(folder) / "run", device=device.type)
        scene = run.load_scene()
        metrics = evaluate(
            scene.eval,
            run.render_view,
            scene.temperature,
            truth=Truth(SCENE / "truth"),
            camera_response=run.camera_response,
        )
        figures = {
            f"{modality} {name}": value
            for modality, values in metrics.mean.items()
            for name, value in values.items()
        } | {f"truth {name}": value for name, value in (metrics.truth or {}).items()}
        found = {name: value for name, value in figures.items() if isinstance(value, float)}
        yield {"method": order.method, "metrics": found}


def _sized(size: Size, measure: Callable[[], Row]) -> Row:
    """A row of a size; with the reason where there is no result, so that the other sizes are
    measured all the same."""
    row: Row = dict(zip(("gaussians", "width", "height"), size, strict=True))
    try:
        return row | measure()
    except Exception as error:
        return row | failure(error)


def _times(summaries: dict[str, Summary]) -> Row:
    return {name: dataclasses.asdict(summary) for name, summary in summaries.items()}


PARTS: dict[str, Callable[[Order], Iterator[Row]]] = {
    "device": device_facts,
    "correctness": correctness,
    "gsplat": beside_gsplat,
    "rasterizer": rasterizer,
    "step": step,
    "training": training,
}
