"""What the terminal shows: notes, counters, the line that follows a training, scores."""

from __future__ import annotations

import shutil
import signal
import sys
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from mrgs.errors import MrgsWarning, SceneError

if TYPE_CHECKING:
    import torch

    from mrgs.comparison.table import Table
    from mrgs.evaluation import Metrics
    from mrgs.export import BakingLoss
    from mrgs.prepare import Preparation, StageReport
    from mrgs.runs.open import Run, TrainedRun
    from mrgs.scene import Scene
    from mrgs.training.driver import Statistics
    from mrgs.training.run_folder import RunConfig

PLAIN_LINE_EVERY_S = 10.0
"""Between progress lines where the output is not a terminal."""

STEPS_REMEMBERED = 250
"""Between two lines; earlier ones weigh less than 1 % in the means that are shown."""

LEFT_OUT_SHOWN = 20
"""Files that are named at the end of a preparation."""


@contextmanager
def plain_warnings() -> Iterator[None]:
    """Show what was mended or left out as one line each, and each once."""
    shown: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        if str(message) in shown:
            return
        shown.add(str(message))
        print(
            f"mrgs: note: {message}"
            if issubclass(category, MrgsWarning)
            else f"warning: {message}",
            file=sys.stderr,
        )

    with warnings.catch_warnings():
        warnings.simplefilter("always", MrgsWarning)
        warnings.showwarning = show
        yield


def counter(verb: str) -> Callable[[int, int], None]:
    """A progress callback: one line that counts up on a terminal, a line at the end elsewhere."""

    def show(done: int, total: int) -> None:
        if sys.stdout.isatty():
            print(f"\r{verb} {done}/{total}", end="\n" if done == total else "", flush=True)
        elif done == total:
            print(f"{verb} {done}/{total}")

    return show


def say_where_to_look(url: str) -> None:
    """The viewer is ready."""
    print(f"open {url} in a browser; Ctrl-C here ends it", flush=True)


def note_gpu(device: torch.device) -> None:
    """Say so if a GPU is used."""
    from mrgs.system.gpu import device_title

    if device.type == "cuda":
        print(f"training on the {device_title(device)}")


def note_unfinished(run: Run) -> None:
    """Say so if the run has not come to its end, since its newest checkpoint is what is used."""
    if run.facts.step < run.config.max_steps:
        print(
            f"mrgs: note: the run is at step {run.facts.step:,} of {run.config.max_steps:,}; "
            "its newest checkpoint is used",
            file=sys.stderr,
        )


def print_baking_loss(loss: BakingLoss) -> None:
    """What plain splats lose against the trained model, as PSNR on the held-out views."""
    named = {"RGB": loss.rgb_db, "thermal": loss.thermal_db}
    known = [
        f"{name} {round(value, 2) + 0.0:.2f} dB"
        for name, value in named.items()
        if value is not None
    ]
    costs = ", ".join(known) or "an unknown amount: there are no held-out views"
    print(f"baking costs {costs}")


def scene_if_there(run: Run) -> Scene | None:
    """The run's scene, or None with a note where it has gone."""
    try:
        return run.load_scene()
    except SceneError as error:
        print(f"mrgs: note: no photos and no captured cameras: {error}", file=sys.stderr)
        return None


class TrainingProgress:
    """The line that follows a training: step, time left, loss, °C, Gaussians, speed.

    The first Ctrl-C ends the training after the step, the second at once.
    """

    def __init__(self) -> None:
        self.unfinished = False
        self._interrupted = False
        self._span_c: float | None = None
        self._max_steps = 0
        self._first_step: int | None = None
        self._started = self._last_line = time.perf_counter()
        self._smoothed: dict[str, float] = {}
        self._unread: deque[Statistics] = deque(maxlen=STEPS_REMEMBERED)
        self._terminal = sys.stdout.isatty()
        self._previous_handler: Any = None

    def __enter__(self) -> None:
        def stop(*_: Any) -> None:
            if self._interrupted:
                raise KeyboardInterrupt
            self._interrupted = True
            print(
                "\nmrgs: stopping after this step; Ctrl-C again stops at once, without a "
                "checkpoint",
                file=sys.stderr,
            )

        self._previous_handler = signal.signal(signal.SIGINT, stop)

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._previous_handler)
        if self._terminal and self._first_step is not None:
            print()

    def start(self, scene: Scene, config: RunConfig) -> None:
        """Say what will be trained."""
        self._max_steps = config.max_steps
        self._span_c = None if scene.temperature is None else scene.temperature.span_c
        print(
            f"{scene.name}: {len(scene.train)} training views, {len(scene.eval)} held out, "
            f"{len(scene.points.positions):,} start points"
        )
        for note in scene.notes:  # what was mended has been shown already, in the same words
            warnings.warn(f"{scene.name}: {note}", MrgsWarning, stacklevel=2)
        print(_plan(scene, config))
        print(
            "The first run on a machine compiles the kernels, which takes up to a minute.",
            flush=True,
        )

    def step(self, statistics: Statistics) -> bool:
        """Show a step; True asks the training to stop."""
        now = time.perf_counter()
        if self._first_step is None:
            # The first step compiles and reads; it would spoil the speed.
            self._first_step, self._started = statistics.step, now
        self._unread.append(statistics)
        interval = 0.2 if self._terminal else PLAIN_LINE_EVERY_S
        self.unfinished = self._interrupted and statistics.step < self._max_steps
        if (
            now - self._last_line >= interval
            or statistics.step == self._max_steps
            or self.unfinished
        ):
            self._last_line = now
            self._read()
            line = self._line(statistics, now)
            if self._terminal:  # a line that wraps would stay
                line = f"\r{line[: shutil.get_terminal_size().columns - 1]}\033[K"
            print(line, end="" if self._terminal else "\n", flush=True)
        return self.unfinished

    def _read(self) -> None:
        """Take up what the steps since the last line measured; only now, because on a GPU to read
        is to wait."""
        for statistics in self._unread:
            self._smooth("loss", statistics.loss)
            if statistics.thermal_error is not None:
                self._smooth("thermal", statistics.thermal_error)
        self._unread.clear()

    def _line(self, statistics: Statistics, now: float) -> str:
        thermal = self._smoothed.get("thermal")
        parts = [f"step {statistics.step:,}/{self._max_steps:,}"]
        steps = statistics.step - (self._first_step or 0)
        speed = steps / (now - self._started) if steps > 0 and now > self._started else None
        if speed is not None:
            parts.append(f"{_duration((self._max_steps - statistics.step) / speed)} left")
        if "loss" in self._smoothed:
            parts.append(f"loss {self._smoothed['loss']:.4f}")
        if thermal is not None:
            parts.append(
                f"thermal {thermal:.4f} (no °C)"
                if self._span_c is None
                else f"thermal {thermal * self._span_c:.2f} °C"
            )
        if statistics.gaussians is not None:
            parts.append(f"{statistics.gaussians:,} Gaussians")
        if speed is not None:
            parts.append(f"{speed:.1f} steps/s")
        return " | ".join(parts)

    def _smooth(self, name: str, value: float) -> None:
        """Mean over about the last fifty steps; values that are not finite are left out."""
        if value - value == 0:
            old = self._smoothed.get(name, value)
            self._smoothed[name] = old + 0.02 * (value - old)


class PrepareProgress:
    """The lines that follow a preparation: the step under way, each stage when it is done, at the
    end what to know."""

    def __init__(self) -> None:
        self._terminal = sys.stdout.isatty()
        self._started = self._last_line = time.perf_counter()
        self._step = ""
        self._warnings: list[str] = []

    def __enter__(self) -> PrepareProgress:
        return self

    def __exit__(self, *_: object) -> None:
        self._clear()
        sys.stdout.flush()
        for text in self._warnings:
            print(f"mrgs: note: {text}", file=sys.stderr)

    def step(self, step: str, done: int, total: int) -> None:
        """Show how far a step is."""
        now = time.perf_counter()
        if step != self._step:
            self._step, self._started = step, now
            self._last_line = now if not self._terminal else 0.0
        if now - self._last_line < (0.1 if self._terminal else PLAIN_LINE_EVERY_S):
            return
        self._last_line = now
        line = f"{step}{f' {done}/{total}' if total else ''} | {_duration(now - self._started)}"
        if self._terminal:  # a line that wraps would stay
            line = f"\r{line[: shutil.get_terminal_size().columns - 1]}\033[K"
        print(line, end="" if self._terminal else "\n", flush=True)

    def stage(self, report: StageReport) -> None:
        """Say what a stage found."""
        self._clear()
        took = "as before" if report.reused else f"{report.seconds:.1f} s"
        first, *others = report.lines
        print(f"{report.title + ':':17}{first} ({took})")
        for line in others:
            print(f"{'':17}{line}")
        sys.stdout.flush()
        self._warnings += [f"{report.title}: {text}" for text in report.warnings]

    def end(self, preparation: Preparation) -> None:
        """Name what was left out."""
        for item in preparation.left_out[:LEFT_OUT_SHOWN]:
            self._warnings.append(f"left out: {item.name}: {item.reason}")
        if (more := len(preparation.left_out) - LEFT_OUT_SHOWN) > 0:
            self._warnings.append(f"left out: {more} more; {preparation.page} lists all")

    def _clear(self) -> None:
        if self._terminal:
            print("\r\033[K", end="")


def _plan(scene: Scene, config: RunConfig) -> str:
    """What will be trained, and the memory that it will need."""
    from mrgs.training import TrainConfig, estimate_bytes

    if not isinstance(config, TrainConfig):
        return f"{config.method}, {config.max_steps:,} steps"
    cap = config.densification.max_gaussians
    first, last = (
        estimate_bytes(scene, config, count) / 2**30
        for count in (min(len(scene.points.positions), cap), cap)
    )
    return (
        f"{config.method}, {config.max_steps:,} steps, at most {cap:,} Gaussians; "
        f"about {first:.1f} GiB of memory at the start, {last:.1f} GiB with all of them"
    )


def _duration(seconds: float) -> str:
    """Minutes and seconds, with hours in front where there are any."""
    minutes, rest = divmod(int(seconds), 60)
    return (
        f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"
        if minutes >= 60
        else f"{minutes}:{rest:02d}"
    )


def print_metrics(run: TrainedRun, metrics: Metrics) -> None:
    """The means, and what they cost."""
    print_figures(metrics)
    gaussians = "" if run.gaussian_count is None else f"{run.gaussian_count:,} Gaussians, "
    print(f"{gaussians}{run.facts.train_seconds / 60:.1f} minutes of training")


def print_figures(metrics: Metrics) -> None:
    """The means, a line for each modality; the second conventions of PSNR and SSIM are in the
    report only."""
    from mrgs.evaluation.report import COLUMNS, format_figure

    for title, figures in (
        ("thermal", metrics.thermal),
        ("RGB", metrics.rgb),
        ("truth", metrics.truth or {}),
    ):
        shown = []
        for name, value in figures.items():
            if isinstance(value, float) and name not in ("psnr_matched", "ssim_pair_range"):
                heading, _, unit = COLUMNS[name][0].partition(", ")
                shown.append(f"{heading} {format_figure(name, value)} {unit}".rstrip())
        if shown:
            print(f"{title + ':':9}{'  '.join(shown)}")


def print_table(table: Table) -> None:
    """A table of a comparison, one block per scene; * marks the best figure, + the second best."""
    from mrgs.comparison.text import to_plain

    print("\n" + to_plain(table), end="")
