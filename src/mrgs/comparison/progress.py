"""The progress lines of a comparison."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from mrgs.comparison.plan import PlannedRun
from mrgs.comparison.processes import Message

LINE_EVERY_S = 10.0


@dataclass
class _Running:
    """Where a run is; ``first_step`` is the first one reported, at ``first_time``: before it,
    kernels compile."""

    started: float
    first_step: int | None = None
    first_time: float = 0.0
    step: int = 0
    doing: str = "starting"


@dataclass
class Progress:
    """Turns the messages of runs into lines for people.

    Attributes:
        jobs: all runs that are due.
        count: how many run at a time.
        say: called with each line.
        clock: seconds.
    """

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
        """Rough; empty while no run has taken a step."""
        if not self._speeds:
            return ""
        seconds = sum(self._seconds_left(job) for job in self.jobs if job not in self._ended)
        minutes = round(seconds / min(self.count, len(self.jobs)) / 60)
        hours = f"{minutes // 60} h " if minutes >= 60 else ""
        return f", about {hours}{minutes % 60} min left" if minutes else ", less than a minute left"

    def _seconds_left(self, job: PlannedRun) -> float:
        """As long as the method's last run took in all; else the steps that are left, at the speeds
        seen so far."""
        running = self._running.get(job)
        if job.method in self._durations:
            elapsed = self.clock() - running.started if running else 0.0
            return max(0.0, self._durations[job.method] - elapsed)
        speed = self._speeds.get(job.method, sum(self._speeds.values()) / len(self._speeds))
        return (job.config.max_steps - (running.step if running else 0)) / speed
