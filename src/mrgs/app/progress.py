"""Progress in the terminal: bars, and lines where there is none."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from threading import Event, Thread
from typing import TYPE_CHECKING, Any, TextIO

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Column

from mrgs.app.interrupts import CTRL_C, Interruption, interrupts
from mrgs.app.style import say_note
from mrgs.system.callers import warn

if TYPE_CHECKING:
    from mrgs.pipeline.forecast import Forecast
    from mrgs.prepare import Preparation, StageReport
    from mrgs.scene import Scene
    from mrgs.training.driver import Statistics
    from mrgs.training.run_folder import RunConfig

PLAIN_LINE_EVERY_S = 10.0
"""Interval of the progress lines if the output is not a terminal."""

REFRESH_EVERY_S = 0.2
"""Interval of a progress bar's updates during training."""

BAR_WIDTH = 12

LEFT_OUT_FIRST = ("speed", "loss", "gaussians", "thermal")
"""Parts of the training's line that a narrow terminal does not show."""

STEPS_REMEMBERED = 250
"""Steps averaged per update; earlier ones weigh less than 1 % in the running means."""

LARGE_PX = 1600
WORTH_A_HINT = 2.0
"""Where photos are wider, and a step is slower by this factor than at this width, a line before a
training says so."""

SKIPPED_SHOWN = 20
"""Skipped files listed at the end of ``mrgs prepare``."""


def _progress_bar(*columns: ProgressColumn, **options: Any) -> Progress:
    """A progress bar on standard output; disabled if that is not a terminal."""
    return Progress(
        *columns,
        console=Console(highlight=False),
        redirect_stderr=sys.stderr.isatty(),
        disable=not sys.stdout.isatty(),
        **options,
    )


def _text_column() -> TextColumn:
    """The task's description on one line, cut off where the terminal ends."""
    column = Column(no_wrap=True, overflow="ellipsis")
    return TextColumn("{task.description}", markup=False, table_column=column)


@contextmanager
def counter(
    verb: str, forecast: Forecast | None = None, clock: Callable[[], float] = time.perf_counter
) -> Iterator[Callable[..., None]]:
    """A progress callback (done, total), or (number, total, name) for parts that have names, both
    with ``left_s`` if the time left is known.

    A bar on a terminal; elsewhere a line for each named part, or else one now and then and one at
    the end.

    Args:
        verb: what is being done.
        forecast: tells the time left of named parts; without it, all parts count the same.
        clock: seconds, monotonic.
    """
    started = last_line = clock()
    with _progress_bar(SpinnerColumn(), _text_column(), BarColumn(BAR_WIDTH)) as bar:
        task = bar.add_task(verb, total=None)

        def show(done: int, total: int, name: str = "", left_s: float | None = None) -> None:
            nonlocal last_line
            now = clock()
            text = f"{verb} {done}/{total}" if total else verb
            if name:
                text = f"{verb} {done} of {total}: {name}" if total else f"{verb}: {name}"
            if left_s is None and name and forecast is not None:
                left_s = forecast.left(name)
            elif left_s is None and done > bool(name):
                finished = done - bool(name)
                left_s = (now - started) / finished * (total - finished)
            if left_s is not None and not (done == total and not name):
                text += f" | {duration(left_s)} left"
            finished = done - 1 if name and done else done
            bar.update(
                task, description=text, completed=finished, total=total or None, refresh=True
            )
            if bar.disable and (name or done == total or now - last_line >= PLAIN_LINE_EVERY_S):
                last_line = now
                print(text, flush=True)

        yield show
        took = duration(clock() - started)
        bar.update(task, description=f"{verb}: {took}", completed=1, total=1, refresh=True)


@contextmanager
def _starting(
    config: RunConfig, compiles: bool, console: Console, line_every_s: float = PLAIN_LINE_EVERY_S
) -> Iterator[None]:
    """Within this block, say how far the kernels of a training are compiled, if it ``compiles`` any
    that are missing, and then how many photos have been read."""
    from mrgs.data.posed import photos_read
    from mrgs.method.config import TrainConfig
    from mrgs.training.compilation import Countdown

    countdown = Countdown(config) if compiles and isinstance(config, TrainConfig) else None
    done = Event()

    def compiling() -> str | None:
        return None if countdown is None else countdown.text

    def show() -> None:
        before = photos_read()
        wait_s = REFRESH_EVERY_S if console.is_terminal else line_every_s
        show_line: Callable[[str], object] = print
        if compiling() is None and done.wait(wait_s):
            return
        with ExitStack() as stack:
            if console.is_terminal:
                show_line = stack.enter_context(console.status("")).update
            while True:
                photos = f"reading photos for the start: {photos_read() - before}"
                show_line(compiling() or photos)
                sys.stdout.flush()
                if done.wait(wait_s):
                    return

    thread = Thread(target=show, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


class TrainingProgress:
    """Progress of a training: step, time left, loss, thermal error, Gaussians, speed.

    Once the training has begun, an interruption ends it after the current step, and a second Ctrl-C
    at once.

    Args:
        compiles: whether the training runs the CPU's kernels, and so compiles those that are
            missing.
        clock: seconds, monotonic.
    """

    def __init__(
        self, compiles: bool = True, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._clock = clock
        self._compiles = compiles
        self.unfinished = False
        self._interruption: Interruption | None = None
        self._span_c: float | None = None
        self._max_steps = 0
        self._first_step: int | None = None
        self._started = self._last_line = clock()
        self._smoothed: dict[str, float] = {}
        self._unread: deque[Statistics] = deque(maxlen=STEPS_REMEMBERED)
        self._bar = _progress_bar(BarColumn(BAR_WIDTH), _text_column(), auto_refresh=False)
        self._task = self._bar.add_task("")
        self._postponed, self._starting = ExitStack(), ExitStack()

    def __enter__(self) -> None:
        self._postponed.__enter__()

    def __exit__(self, *_: object) -> None:
        self._starting.close()
        self._postponed.close()
        if self._first_step is not None:
            self._bar.stop()

    @property
    def has_stepped(self) -> bool:
        """Whether there was a step."""
        return self._first_step is not None

    @property
    def max_steps(self) -> int:
        """Training steps; 0 before the start."""
        return self._max_steps

    @property
    def sink(self) -> TextIO:
        """Where the last words go: standard output, unless it is lost."""
        is_signal = self._interruption is None or self._interruption.status >= 128
        return sys.stdout if is_signal else sys.stderr

    def _interrupt(self, interruption: Interruption) -> None:
        """End the training after this step."""
        self._interruption = interruption
        if interruption.cause == CTRL_C:
            then = "; press Ctrl-C again to stop now, without a checkpoint"
        else:
            then = f": {interruption.cause}"
        print(f"mrgs: stopping after this step{then}", file=sys.stderr)

    def start(self, scene: Scene, config: RunConfig) -> None:
        """Print what will be trained; from here on interruptions wait for the end of a step."""
        self._postponed.enter_context(interrupts.postponed(self._interrupt))
        self._max_steps = config.max_steps
        self._span_c = None if scene.temperature is None else scene.temperature.span_c
        print(
            f"{scene.name}: {len(scene.train)} training views, {len(scene.eval)} held out, "
            f"{len(scene.points.positions):,} start points"
        )
        for note in scene.notes:  # those already shown are not repeated
            warn(f"{scene.name}: {note}")
        print(_plan(scene, config))
        if (hint := _hint_at_resolution(scene, config)) is not None:
            say_note(hint)
        sys.stdout.flush()
        self._starting.enter_context(_starting(config, self._compiles, self._bar.console))

    def step(self, statistics: Statistics) -> bool:
        """Show a step; returns True to stop the training."""
        now = self._clock()
        if self._first_step is None:
            # Not counted in the speed: the first step compiles kernels and reads photos.
            self._starting.close()
            self._first_step, self._started = statistics.step, now
            self._bar.update(self._task, total=self._max_steps)
            self._bar.start()
        self._unread.append(statistics)
        interval = PLAIN_LINE_EVERY_S if self._bar.disable else REFRESH_EVERY_S
        self.unfinished = self._interruption is not None and statistics.step < self._max_steps
        if (
            now - self._last_line >= interval
            or statistics.step == self._max_steps
            or self.unfinished
        ):
            self._last_line = now
            self._read()
            parts = self._parts(statistics, now)
            if self._bar.disable:
                print(" | ".join(parts.values()), flush=True)
            else:
                line = _fitted(parts, self._bar.console.width - BAR_WIDTH - 1)
                self._bar.update(
                    self._task, completed=statistics.step, description=line, refresh=True
                )
        return self.unfinished

    def _read(self) -> None:
        """Read what the steps since the last update measured; not earlier, because on a GPU
        reading waits."""
        for statistics in self._unread:
            self._smooth("loss", statistics.loss)
            if statistics.thermal_error is not None:
                self._smooth("thermal", statistics.thermal_error)
        self._unread.clear()

    def _parts(self, statistics: Statistics, now: float) -> dict[str, str]:
        """What a line says, by name."""
        parts = {"step": f"step {statistics.step:,}/{self._max_steps:,}"}
        steps = statistics.step - (self._first_step or 0)
        speed = steps / (now - self._started) if steps > 0 and now > self._started else None
        if speed is not None:
            left = duration((self._max_steps - statistics.step) / speed)
            parts["time"] = f"{left} left"
        if "loss" in self._smoothed:
            parts["loss"] = f"loss {self._smoothed['loss']:.4f}"
        thermal = self._smoothed.get("thermal")
        if thermal is not None:
            parts["thermal"] = (
                f"thermal error {thermal:.3f} (normalised)"
                if self._span_c is None
                else f"thermal error {thermal * self._span_c:.2f} °C"
            )
        if statistics.gaussians is not None:
            parts["gaussians"] = f"{statistics.gaussians:,} Gaussians"
        if speed is not None:
            parts["speed"] = f"{speed:.1f} steps/s"
        return parts

    def _smooth(self, name: str, value: float) -> None:
        """Update the mean over about the last fifty steps; skips values that are not finite."""
        if value - value == 0:
            old = self._smoothed.get(name, value)
            self._smoothed[name] = old + 0.02 * (value - old)


class PrepareProgress:
    """Progress of ``mrgs prepare``: the current step, each finished stage, warnings at the end.

    Args:
        clock: seconds, monotonic.

    Attributes:
        forecast: of the whole, where the time left is not given with each step.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self.forecast: Forecast | None = None
        self._started = self._last_line = clock()
        self._step = ""
        self._warnings: list[str] = []
        self._bar = _progress_bar(
            SpinnerColumn(), _text_column(), TimeElapsedColumn(), transient=True
        )

    def __enter__(self) -> PrepareProgress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
        sys.stdout.flush()
        for text in self._warnings:
            say_note(text)

    def step(self, step: str, done: int, total: int, left_s: float | None = None) -> None:
        """Show how far a step is, and the time left of all steps if it is known."""
        now = self._clock()
        text = f"{step} {done}/{total}" if total else step
        if left_s is None and self.forecast is not None:
            left_s = self.forecast.left(step, done / total if total else None)
        elif left_s is None and done and step == self._step:
            left_s = (now - self._started) / done * (total - done)
        if left_s is not None:
            text += f" | {duration(left_s)} left"
        if step != self._step:
            self._step, self._started, self._last_line = step, now, now
            for task in self._bar.task_ids:
                self._bar.remove_task(task)
            self._bar.add_task(text, total=None)
            self._bar.start()
        if not self._bar.disable:
            self._bar.update(self._bar.task_ids[0], description=text)
        elif now - self._last_line >= PLAIN_LINE_EVERY_S:
            self._last_line = now
            print(f"{text} | {duration(now - self._started)}", flush=True)

    def pause(self) -> None:
        """Clear the bar, until the next step."""
        self._bar.stop()
        self._step = ""

    def stage(self, report: StageReport, *, warn: bool = True) -> None:
        """Print what a stage found; its warnings follow at the end, unless ``warn`` is False."""
        self.pause()
        took = "as before" if report.reused else f"{report.seconds:.1f} s"
        first, *others = report.lines
        print(f"{report.title + ':':17}{first} ({took})")
        for line in others:
            print(f"{'':17}{line}")
        sys.stdout.flush()
        if warn:
            self._warnings += [f"{report.title}: {text}" for text in report.warnings]

    def end(self, preparation: Preparation) -> None:
        """List the skipped files."""
        for item in preparation.skipped[:SKIPPED_SHOWN]:
            self._warnings.append(f"skipped: {item.name}: {item.reason}")
        if (more := len(preparation.skipped) - SKIPPED_SHOWN) > 0:
            self._warnings.append(f"skipped: {more} more; see {preparation.page}")


def _fitted(parts: Mapping[str, str], width: int) -> str:
    """The parts that fit into a line of this width, the least important ones left out."""
    shown = dict(parts)
    for name in LEFT_OUT_FIRST:
        if len(" | ".join(shown.values())) <= width:
            break
        shown.pop(name, None)
    return " | ".join(shown.values())


def _plan(scene: Scene, config: RunConfig) -> str:
    """Method, steps, cap on the Gaussians, and the memory needed."""
    from mrgs.training import TrainConfig, estimate_bytes
    from mrgs.training.compilation import compiling_progress
    from mrgs.training.memory import gaussian_bytes

    if not isinstance(config, TrainConfig):
        return f"{config.method}, {config.max_steps:,} steps"
    cap = config.densification.max_gaussians
    compiles = compiling_progress(config).seconds_left > 0
    start = min(len(scene.points.positions), cap)
    # Once, for it reads photos.
    first = estimate_bytes(scene, config, start, compiles=compiles)
    last = first + (cap - start) * gaussian_bytes(scene, config)
    return (
        f"{config.method}, {config.max_steps:,} steps, at most {cap:,} Gaussians; "
        f"memory: about {first / 2**30:.1f} GiB at the start, "
        f"{last / 2**30:.1f} GiB at the cap"
    )


def _hint_at_resolution(scene: Scene, config: RunConfig) -> str | None:
    """What a smaller resolution would save, where photos are so large that this is much."""
    from mrgs.pipeline.forecast import step_seconds
    from mrgs.training import TrainConfig

    cameras = scene.train[0].cameras.values()
    widest = max(cameras, key=lambda camera: camera.width)
    if not isinstance(config, TrainConfig) or widest.width <= LARGE_PX:
        return None
    pixels = [camera.width * camera.height for camera in cameras]
    shares = [min(1.0, LARGE_PX / camera.width) ** 2 for camera in cameras]
    reduced = sum(count * share for count, share in zip(pixels, shares, strict=True))
    cap = config.densification.max_gaussians
    factor = step_seconds(cap, sum(pixels) / 1e3) / step_seconds(cap, reduced / 1e3)
    if factor < WORTH_A_HINT:
        return None
    return (
        f"photos are {widest.width}×{widest.height} px; with --resolution {LARGE_PX} a step takes "
        f"about {1 / factor:.0%} of the time"
    )


def duration(seconds: float) -> str:
    """M:SS, or H:MM:SS from an hour on."""
    minutes, rest = divmod(int(seconds), 60)
    return (
        f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"
        if minutes >= 60
        else f"{minutes}:{rest:02d}"
    )
