"""Progress in the terminal: one line that changes in place, or lines now and then elsewhere."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, TextIO

from mrgs.app.interrupts import CTRL_C, Interruption, interrupts
from mrgs.app.terminal import print_note, say
from mrgs.errors import warn_user

if TYPE_CHECKING:
    from mrgs.pipeline.forecast import Forecast
    from mrgs.prepare import Preparation, StageReport
    from mrgs.run_files.folder import RunConfig
    from mrgs.run_files.record import StepStatistics
    from mrgs.scene import Scene

PLAIN_LINE_EVERY_S = 10.0
"""Interval of the lines if the output is not a terminal."""

REFRESH_EVERY_S = 0.2
"""Interval of a progress bar's updates during training."""

BAR_WIDTH = 12

STEPS_REMEMBERED = 250
"""Steps averaged per update; earlier ones weigh less than 1 % in the running means."""

LARGE_PX = 1600
"""Width that is suggested for photos with which a step takes more than twice as long."""

SKIPPED_SHOWN = 20
"""Skipped files listed at the end of ``mrgs prepare``."""

Clock = Callable[[], float]


class _Line:
    """A line that changes in place; where the output is neither a terminal nor a notebook, a line
    now and then. The columns are among "text", "bar", "spinner" and "time", which counts up."""

    def __init__(self, *columns: str, clock: Clock, **options: Any) -> None:
        # Imported here, so that a help text comes at once.
        from rich import progress as bars
        from rich.console import Console
        from rich.table import Column

        kinds = {
            "text": bars.TextColumn(
                "{task.description}",
                markup=False,
                table_column=Column(no_wrap=True, overflow="ellipsis"),
            ),
            "bar": bars.BarColumn(BAR_WIDTH),
            "spinner": bars.SpinnerColumn(),
            "time": bars.TimeElapsedColumn(),
        }
        self.bar = bars.Progress(
            *(kinds[column] for column in columns),
            console=Console(highlight=False),
            redirect_stderr=sys.stderr.isatty(),
            disable=not sys.stdout.isatty(),
            **options,
        )
        self.clock, self.last = clock, clock()
        self._in_notebook, self._width = self.bar.console.is_jupyter, 0

    @property
    def changes(self) -> bool:
        """Whether the line changes in place."""
        return self._in_notebook or not self.bar.disable

    def is_due(self, every_s: float = PLAIN_LINE_EVERY_S) -> bool:
        """Whether the last line was shown this long ago."""
        return self.clock() - self.last >= every_s

    def show(self, text: str, done: int, total: int | None) -> None:
        """Show the line now, with the share of the bar that is done."""
        self.last = self.clock()
        if self._in_notebook:  # without ipywidgets, which rich needs there
            filled = BAR_WIDTH * done // max(total or 0, done, 1)
            text = f"{'█' * filled}{'░' * (BAR_WIDTH - filled)} {text}"
            print(f"\r{text:{self._width}}", end="", flush=True)
            self._width = len(text)
            return
        if self.bar.disable:
            print(text, flush=True)
            return
        if not self.bar.task_ids:
            self.bar.add_task(text, total=None)
        self.bar.start()
        self.bar.update(
            self.bar.task_ids[0], description=text, completed=done, total=total, refresh=True
        )

    def end(self) -> None:
        """Leave the line as it is."""
        self.bar.stop()
        if self._width:
            print()
            self._width = 0

    def clear(self) -> None:
        """End the line; the next update begins a new one."""
        self.end()
        for task in self.bar.task_ids:
            self.bar.remove_task(task)


@contextmanager
def progress_bar(
    title: str, forecast: Forecast | None = None, clock: Clock = time.perf_counter
) -> Iterator[Callable[..., None]]:
    """A progress bar in the terminal or in the notebook, for the ``progress`` of any function of
    this package: ``with progress_bar("training") as show: train(scene, progress=show)``. A line
    every ten seconds where the output is a file, and one for each named part.

    Loops of one's own call ``show(done, total)``. Functions with named parts call it with (number,
    total, part) when a part begins, others with (step, done, total). ``left_s`` is the time left if
    it is known; ``forecast`` knows that of parts."""
    line, started = _Line("spinner", "text", "bar", clock=clock), clock()
    begun: dict[str, tuple[int, float]] = {}

    def show(*told: str | int, left_s: float | None = None) -> None:
        name = next((each for each in told if isinstance(each, str)), "")
        done, total = (each for each in told if not isinstance(each, str))
        is_part, text = bool(name) and told[0] != name, ": ".join(filter(None, [title, name]))
        if is_part and total:
            text = f"{title} {done} of {total}: {name}"
        elif total and not is_part:
            text += f" {done}/{total}"
        finished = done - 1 if is_part and done else done
        # From the first call of a step on: neither compiling nor what a resumed training had done
        # before counts in its speed.
        first, since = begun.setdefault("" if is_part else name, (finished, clock()))
        if left_s is None and is_part and forecast is not None:
            left_s = forecast.left(name)
        elif left_s is None and finished > first:
            left_s = (clock() - since) / (finished - first) * (total - finished)
        if left_s is not None and (is_part or done != total):
            text += f" | {duration(left_s)} left"
        is_first = line.changes and finished == first
        every_s = REFRESH_EVERY_S if line.changes else PLAIN_LINE_EVERY_S
        if is_part or is_first or done == total or line.is_due(every_s):
            line.show(text, finished, total or None)

    try:
        if line.changes:
            line.show(title, 0, None)
        yield show
        if line.changes:
            line.show(f"{title}: {duration(clock() - started)}", 1, 1)
    finally:
        line.end()


class TrainingProgress:
    """Progress of a training: ``max_steps``, 0 before the start, and whether it is ``unfinished``,
    interrupted before the last of them. Once it has begun, an interruption ends it after the
    current step; a second Ctrl-C at once."""

    def __init__(self, clock: Clock = time.perf_counter) -> None:
        self.unfinished = False
        self.max_steps = 0
        self._interruption: Interruption | None = None
        self._span_c: float | None = None
        self._first_step: int | None = None
        self._started = clock()
        self._smoothed: dict[str, float] = {}
        self._unread: deque[StepStatistics] = deque(maxlen=STEPS_REMEMBERED)
        self._line = _Line("bar", "text", clock=clock, auto_refresh=False)
        self._postponed = ExitStack()

    def __enter__(self) -> None:
        self._postponed.__enter__()

    def __exit__(self, *_: object) -> None:
        self._postponed.close()
        self._line.bar.stop()

    @property
    def has_stepped(self) -> bool:
        """Whether there was a step."""
        return self._first_step is not None

    @property
    def sink(self) -> TextIO:
        """Stream of the last message: standard output, unless it is lost."""
        is_signal = self._interruption is None or self._interruption.status >= 128
        return sys.stdout if is_signal else sys.stderr

    def _interrupt(self, interruption: Interruption) -> None:
        """End the training after this step."""
        self._interruption, then = interruption, f": {interruption.cause}"
        if interruption.cause == CTRL_C:
            then = "; press Ctrl-C again to stop now, without a checkpoint"
        print(f"mrgs: stopping after this step{then}", file=sys.stderr)

    def start(self, scene: Scene, config: RunConfig) -> None:
        """Print what will be trained; from here on interruptions wait for the end of a step."""
        self._postponed.enter_context(interrupts.postponed(self._interrupt))
        self.max_steps = config.max_steps
        self._span_c = None if scene.temperature is None else scene.temperature.span_c
        say(
            f"{scene.name}: {len(scene.train)} training views, {len(scene.eval)} held out, "
            f"{len(scene.points.positions):,} start points"
        )
        for note in scene.notes:  # those already shown are not repeated
            warn_user(f"{scene.name}: {note}")
        print(_plan(scene, config))
        if (hint := _hint_at_resolution(scene, config)) is not None:
            print_note(hint)
        sys.stdout.flush()
        if not self._line.bar.disable:
            self._line.show("reading photos, compiling kernels", 0, None)

    def step(self, statistics: StepStatistics) -> bool:
        """Show a step; returns True to stop the training."""
        if self._first_step is None:
            # Not counted in the speed: the first step compiles kernels and reads photos.
            self._first_step, self._started = statistics.step, self._line.clock()
        self._unread.append(statistics)
        is_last = statistics.step == self.max_steps
        self.unfinished = self._interruption is not None and not is_last
        is_plain = self._line.bar.disable
        every_s = PLAIN_LINE_EVERY_S if is_plain else REFRESH_EVERY_S
        if self._line.is_due(every_s) or is_last or self.unfinished:
            # What the steps since the last update measured; on a GPU, reading waits.
            for each in self._unread:
                for name, value in (("loss", each.loss), ("thermal", each.thermal_error)):
                    if value is not None and value - value == 0:  # finite
                        old = self._smoothed.get(name, value)  # the mean over about fifty steps
                        self._smoothed[name] = old + 0.02 * (value - old)
            self._unread.clear()
            self._line.show(self._text(statistics), statistics.step, self.max_steps)
        return self.unfinished

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Within this block there are no steps: its time does not count in their speed."""
        began = self._line.clock()
        try:
            yield
        finally:
            self._started += self._line.clock() - began

    def _text(self, statistics: StepStatistics) -> str:
        """The line; a narrow terminal cuts off its end."""
        parts, speed = [f"step {statistics.step:,}/{self.max_steps:,}"], None
        steps = statistics.step - (self._first_step or 0)
        seconds = self._line.clock() - self._started
        if steps > 0 and seconds > 0:
            speed = steps / seconds
            parts.append(f"{duration((self.max_steps - statistics.step) / speed)} left")
        if "loss" in self._smoothed:
            parts.append(f"loss {self._smoothed['loss']:.4f}")
        if (thermal := self._smoothed.get("thermal")) is not None:
            error = f"{thermal:.3f} (normalised)"
            if self._span_c is not None:
                error = f"{thermal * self._span_c:.2f} °C"
            parts.append(f"thermal error {error}")
        if statistics.gaussians is not None:
            parts.append(f"{statistics.gaussians:,} Gaussians")
        return " | ".join([*parts, *([] if speed is None else [f"{speed:.1f} steps/s"])])


class PrepareProgress:
    """Progress of ``mrgs prepare``: the current step, each finished stage, warnings at the end.
    ``forecast`` is that of the whole, where the time left is not given with each step."""

    def __init__(self, clock: Clock = time.perf_counter) -> None:
        self.forecast: Forecast | None = None
        self._step = ""
        self._started = clock()
        self._warnings: list[str] = []
        self._line = _Line("spinner", "text", "time", clock=clock, transient=True)

    def __enter__(self) -> PrepareProgress:
        return self

    def __exit__(self, *_: object) -> None:
        self._line.bar.stop()
        sys.stdout.flush()
        for text in self._warnings:
            print_note(text)

    def step(self, step: str, done: int, total: int, left_s: float | None = None) -> None:
        """Show how far a step is, and the time left of all steps if it is known."""
        now = self._line.clock()
        text = f"{step} {done}/{total}" if total else step
        if left_s is None and self.forecast is not None:
            left_s = self.forecast.left(step, done / total if total else None)
        elif left_s is None and done and step == self._step:
            left_s = (now - self._started) / done * (total - done)
        if left_s is not None:
            text += f" | {duration(left_s)} left"
        if step != self._step:
            self._line.clear()
            self._step, self._started, self._line.last = step, now, now
        if not self._line.bar.disable:
            self._line.show(text, done, None)
        elif self._line.is_due():
            self._line.show(f"{text} | {duration(now - self._started)}", done, None)

    def pause(self) -> None:
        """Clear the bar, until the next step."""
        self._line.clear()
        self._step = ""

    def stage(self, report: StageReport, *, warn: bool = True) -> None:
        """Print what a stage found; its warnings follow at the end, unless ``warn`` is False."""
        self.pause()
        took = "as before" if report.reused else f"{report.seconds:.1f} s"
        first, *others = report.lines
        say(f"{report.title + ':':17}{first} ({took})", *(f"{'':17}{line}" for line in others))
        if warn:
            self._warnings += [f"{report.title}: {text}" for text in report.warnings]

    def end(self, preparation: Preparation) -> None:
        """List the skipped files."""
        for item in preparation.skipped[:SKIPPED_SHOWN]:
            self._warnings.append(f"skipped: {item.name}: {item.reason}")
        if (more := len(preparation.skipped) - SKIPPED_SHOWN) > 0:
            self._warnings.append(f"skipped: {more} more; see {preparation.page}")


def _plan(scene: Scene, config: RunConfig) -> str:
    """Method, steps, cap on the Gaussians, and the memory needed."""
    from mrgs.kernels.cache import are_compiled
    from mrgs.scene.capture import Capture
    from mrgs.training import TrainConfig, estimate_bytes
    from mrgs.training.memory import gaussian_bytes

    text = f"{config.method}, {config.max_steps:,} steps"
    if not isinstance(config, TrainConfig):
        return text
    cap, compiles = config.densification.max_gaussians, not are_compiled()
    start = min(len(scene.points.positions), cap)
    first = estimate_bytes(scene, config, start, compiles=compiles)  # once, for it reads photos
    each = gaussian_bytes(config, scene.modalities, Capture.of(scene))
    last = first + (cap - start) * each
    text += f", at most {cap:,} Gaussians; memory: about {first / 2**30:.1f} GiB at the start, "
    text += f"{last / 2**30:.1f} GiB at the cap"
    return text + (
        "; kernels are compiled first, which takes about a minute, once" if compiles else ""
    )


def _hint_at_resolution(scene: Scene, config: RunConfig) -> str | None:
    """What a smaller resolution would save, if the photos are so large that this is much."""
    from mrgs.pipeline.forecast import step_seconds
    from mrgs.training import TrainConfig

    if not isinstance(config, TrainConfig):
        return None
    cameras = scene.train[0].cameras.values()
    widest = max(cameras, key=lambda camera: camera.width)
    cap, step_s = config.densification.max_gaussians, {}
    for width in (widest.width, min(widest.width, LARGE_PX)):
        pixels = sum(each.width * each.height * min(1, width / each.width) ** 2 for each in cameras)
        step_s[width] = step_seconds(cap, pixels / 1e3)
    share = min(step_s.values()) / max(step_s.values())
    if share >= 0.5:
        return None
    return (
        f"photos are {widest.width}×{widest.height} px; with --resolution {LARGE_PX} a step takes "
        f"about {share:.0%} of the time"
    )


def duration(seconds: float) -> str:
    """M:SS, or H:MM:SS from an hour on."""
    minutes, rest = divmod(int(seconds), 60)
    hours, part = divmod(minutes, 60)
    return f"{hours}:{part:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
