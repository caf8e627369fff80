"""Interleaved timing: every stage of a case once per round, the calibration kernel in each round
too."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from benchmarks.plan import Effort


def _nothing() -> None:
    """A stage whose input does not change from run to run."""


@dataclass(frozen=True)
class Timing:
    """A stage.

    Attributes:
        name: as the report prints it.
        run: what is timed; takes what ``setup`` returned.
        setup: called before every run, not timed.
    """

    name: str
    run: Callable[[Any], object]
    setup: Callable[[], Any] = _nothing


@dataclass(frozen=True)
class Stages:
    """What is measured together.

    Attributes:
        timings: the stages, in the order they are run in.
        notes: facts for the report, such as how well two ways agree.
    """

    timings: list[Timing]
    notes: dict[str, str] = field(default_factory=dict)


class SkippedError(Exception):
    """A case cannot be measured here; the message says why."""


@dataclass(frozen=True)
class Summary:
    """Milliseconds of the runs of a stage: median, quartiles, least; and how many runs there
    were."""

    median_ms: float
    q1_ms: float
    q3_ms: float
    min_ms: float
    runs: int

    @classmethod
    def of(cls, samples_ms: Sequence[float]) -> Summary:
        """Summarise at least one run; the quartiles are interpolated, as numpy's."""
        runs = len(samples_ms)
        if runs == 1:
            samples_ms = [samples_ms[0]] * 2
        q1, median, q3 = statistics.quantiles(samples_ms, n=4, method="inclusive")
        return cls(median, q1, q3, min(samples_ms), runs)


def measure(timings: Sequence[Timing], effort: Effort) -> dict[str, Summary]:
    """Run the stages in turns, so that a machine that slows down slows all of them."""
    for _ in range(effort.warm_up):
        for timing in timings:
            timing.run(timing.setup())
    samples: dict[str, list[float]] = {timing.name: [] for timing in timings}
    started = time.perf_counter()
    for done in range(effort.runs):
        if done >= effort.fewest and time.perf_counter() - started > effort.seconds:
            break
        for timing in timings:
            samples[timing.name].append(_milliseconds(timing))
    return {name: Summary.of(times) for name, times in samples.items()}


def _milliseconds(timing: Timing) -> float:
    argument = timing.setup()
    started = time.perf_counter()
    timing.run(argument)
    return 1e3 * (time.perf_counter() - started)
