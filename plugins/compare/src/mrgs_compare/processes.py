"""Runs side by side, each in a process of its own, so that its memory is freed and its crash does
not affect others; and the lines that report their progress."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mrgs.system.child import OUT_OF_MEMORY, Child, Message
from mrgs.system.gpu import DeviceName
from mrgs.system.strict_yaml import write_yaml
from mrgs.system.threads import available_cores
from mrgs_compare.plan import PlannedRun

CHILD = ("-m", "mrgs_compare.child")
TICK_S = 1.0
LINE_EVERY_S = 10.0


@dataclass(eq=False)
class _Run:
    job: PlannedRun
    child: Child


_Inbox = queue.Queue[tuple[_Run, Message | None]]
"""What the children send; None when one has ended."""


def run_jobs(
    jobs: Sequence[PlannedRun],
    count: int,
    lpips_weights: Path | None,
    on_message: Callable[[PlannedRun, Message], None],
    on_tick: Callable[[], None],
    device: DeviceName = "auto",
    child: Sequence[str] = CHILD,
) -> dict[PlannedRun, str]:
    """Execute all runs, ``count`` at a time. Returns the reason, one line, of each job that failed.

    Args:
        jobs: in the order in which they are started.
        count: number of parallel processes, which share the cores.
        on_message: called with each message of a child, and with ``{"start": True}`` when it
            starts.
        child: arguments of the Python process that does a run.

    Raises:
        KeyboardInterrupt: Ctrl-C; the running jobs have left checkpoints. A second one ends them at
            once.
    """
    waiting, running, failures = list(jobs), list[_Run](), dict[PlannedRun, str]()
    inbox: _Inbox = queue.Queue()
    threads = threads_each(max(1, min(count, len(jobs))))
    try:
        while waiting or running:
            while waiting and len(running) < count:
                job = waiting.pop(0)
                running.append(_start(child, job, threads, device, lpips_weights, inbox))
                on_message(job, {"start": True})
            _receive(inbox, running, failures, on_message)
            on_tick()
    except KeyboardInterrupt:
        for run in running:
            run.child.stop()
        while running:
            _receive(inbox, running, failures, on_message)
        raise
    finally:
        for run in running:  # something went wrong here, or a second Ctrl-C
            run.child.close()
    return failures


def threads_each(count: int) -> int:
    """The threads of one of ``count`` processes."""
    return max(1, available_cores() // count)


def _start(
    child: Sequence[str],
    job: PlannedRun,
    threads: int,
    device: DeviceName,
    lpips_weights: Path | None,
    inbox: _Inbox,
) -> _Run:
    request = {
        "scene": str(job.scene.absolute()),  # the child runs in another folder
        "folder": str(job.folder.absolute()),
        "config": write_yaml(job.config),
        "device": device,
        "lpips_weights": None if lpips_weights is None else str(lpips_weights.absolute()),
    }
    log = job.folder.parent / f"{job.folder.name}.stderr.txt"
    log.parent.mkdir(parents=True, exist_ok=True)
    limits = {"OMP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}
    run = _Run(job, Child(child, request, log, **limits))

    def listen() -> None:
        for message in run.child.messages():
            inbox.put((run, message))
        inbox.put((run, None))

    threading.Thread(target=listen, daemon=True).start()
    return run


def _receive(
    inbox: _Inbox,
    running: list[_Run],
    failures: dict[PlannedRun, str],
    on_message: Callable[[PlannedRun, Message], None],
) -> None:
    """Handle one message, or let a tick pass."""
    try:
        run, message = inbox.get(timeout=TICK_S)
    except queue.Empty:
        return
    if message is not None:
        on_message(run.job, message)
        return
    running.remove(run)
    run.child.close()
    reason = run.child.failure()
    if reason is None or run.child.end.get("end") == "error":
        run.child.log.unlink(missing_ok=True)
    else:  # the log has more
        more = ": run fewer at a time" if reason == OUT_OF_MEMORY else f"; see {run.child.log}"
        reason += more
    if reason is None:
        on_message(run.job, run.child.end)
    else:
        failures[run.job] = reason
        on_message(run.job, {"end": "error", "message": reason})


@dataclass
class _Running:
    """Where a run is; ``first_step`` was the first report, at ``first_time``, after compilation."""

    started: float
    first_step: int | None = None
    first_time: float = 0.0
    step: int = 0
    doing: str = "starting"


@dataclass
class Progress:
    """Turns the messages of runs into lines for people."""

    jobs: Sequence[PlannedRun]
    count: int
    say: Callable[[str], None]
    clock: Callable[[], float] = time.monotonic
    _running: dict[PlannedRun, _Running] = field(default_factory=dict)
    _speeds: dict[str, float] = field(default_factory=dict)
    _durations: dict[str, float] = field(default_factory=dict)
    _ended: set[PlannedRun] = field(default_factory=set)
    _last_line: float = field(default=0.0)

    def on_message(self, job: PlannedRun, message: Message) -> None:
        """Handle a message: a run starts, takes steps, is scored, warns or ends."""
        if "start" in message:
            self._running[job] = _Running(self.clock())
            self.say(f"starts: {job}")
        elif "step" in message:
            self._step(job, int(message["step"]))
        elif "scored" in message:
            self._running[job].step = job.config.max_steps
            self._running[job].doing = f"scoring {message['scored']}/{message['of']}"
        elif "warning" in message:
            self.say(f"{job}: {message['warning']}")
        else:
            self._end(job, message)

    def on_tick(self) -> None:
        """Report the progress of all runs every few seconds."""
        now = self.clock()
        if self._running and now - self._last_line >= LINE_EVERY_S:
            self._last_line = now
            parts = [f"{len(self._ended)} of {len(self.jobs)} done{self._time_left()}"]
            parts += [f"{job}: {running.doing}" for job, running in self._running.items()]
            self.say(" | ".join(parts))

    def _step(self, job: PlannedRun, step: int) -> None:
        running, now = self._running[job], self.clock()
        if running.first_step is None:
            running.first_step, running.first_time = step, now
        running.step = step
        running.doing = f"step {step:,}/{job.config.max_steps:,}"
        if step > running.first_step and now > running.first_time:
            speed = (step - running.first_step) / (now - running.first_time)
            self._speeds[job.method] = speed
            running.doing += f", {speed:.1f} steps/s"

    def _end(self, job: PlannedRun, message: Message) -> None:
        running = self._running.pop(job)
        if message["end"] == "scored":
            self._durations[job.method] = self.clock() - running.started
        if message["end"] != "stopped":
            self._ended.add(job)
        verb = {"scored": "scored", "stopped": "stopped", "error": "failed"}[message["end"]]
        reason = f" ({message['message']})" if message["end"] == "error" else ""
        self.say(f"{verb}: {job}{reason} | {len(self._ended)} of {len(self.jobs)} done")

    def _time_left(self) -> str:
        """Rough: as long as the method's last run took, or else the steps left at the speeds seen
        so far; empty while no run has taken a step."""
        if not self._speeds:
            return ""
        mean, seconds = sum(self._speeds.values()) / len(self._speeds), 0.0
        for job in (each for each in self.jobs if each not in self._ended):
            running = self._running.get(job)
            if job.method in self._durations:
                elapsed = self.clock() - running.started if running else 0.0
                seconds += max(0.0, self._durations[job.method] - elapsed)
            else:
                steps = job.config.max_steps - (running.step if running else 0)
                seconds += steps / self._speeds.get(job.method, mean)
        minutes = round(seconds / min(self.count, len(self.jobs)) / 60)
        hours = f"{minutes // 60} h " if minutes >= 60 else ""
        return f", about {hours}{minutes % 60} min left" if minutes else ", less than a minute left"
