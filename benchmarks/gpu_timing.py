"""Timing on a GPU with its own clock, what it can do at most, and how often the host waits for it.

On the CPU the same functions use the host's clock, so that the benchmark can be tried without a
GPU.
"""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import torch

from benchmarks.plan import Effort
from benchmarks.timing import Summary
from mrgs.system.cuda_graph import sync_debug_mode

FLUSH_BYTES = 2**28
"""Written before every timed run: larger than any cache, so that no run finds its inputs there."""

CEILING_REPEATS = 10


class Clock:
    """Times work on a device."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._flush = (
            torch.empty(FLUSH_BYTES, dtype=torch.uint8, device=device)
            if device.type == "cuda"
            else None
        )

    def measure(
        self, runs: Mapping[str, Callable[[], object]], effort: Effort, flush: bool = True
    ) -> dict[str, Summary]:
        """Milliseconds of each run; they are taken in turns, and every other round in reverse
        order.

        Args:
            runs: what is timed, by name.
            effort: how often.
            flush: empty the caches before each run; not where a run is long, or leaves the caches
                as it finds them.
        """
        for _ in range(effort.warm_up):
            for run in runs.values():
                run()
        self.wait()
        rounds: list[dict[str, Callable[[], float]]] = []
        started = time.perf_counter()
        while len(rounds) < effort.runs:
            if len(rounds) >= effort.fewest and time.perf_counter() - started > effort.seconds:
                break
            order = list(runs) if len(rounds) % 2 == 0 else list(runs)[::-1]
            rounds.append({name: self._start(runs[name], flush) for name in order})
        self.wait()
        return {name: Summary.of([samples[name]() for samples in rounds]) for name in runs}

    def wait(self) -> None:
        """Until the device has done everything."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def _start(self, run: Callable[[], object], flush: bool) -> Callable[[], float]:
        """Queue a run; what is returned gives its milliseconds once the device has done it."""
        if self._flush is None:
            started = time.perf_counter()
            run()
            milliseconds = 1e3 * (time.perf_counter() - started)
            return lambda: milliseconds
        if flush:
            self._flush.zero_()
        first, last = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        first.record()
        run()
        last.record()
        return lambda: first.elapsed_time(last)


def ceilings(clock: Clock, size: int) -> dict[str, float]:
    """What the device does at most: bytes per second, float32 operations per second, and seconds
    per tiny operation.

    Args:
        clock: of the device.
        size: side of the matrices; the copied tensor has four times as many elements.
    """
    device, effort = clock.device, Effort(CEILING_REPEATS, 5.0, 3, 2)
    source = torch.rand(4 * size * size, device=device)
    target = torch.empty_like(source)
    x, y, product = (torch.rand(size, size, device=device) for _ in range(3))
    tiny = torch.zeros(32, device=device)

    def many_tiny() -> None:
        for _ in range(1000):
            tiny.add_(1)

    runs = {
        "copy": lambda: target.copy_(source),
        "product": lambda: torch.mm(x, y, out=product),
        "tiny": many_tiny,
    }
    times = {name: summary.median_ms / 1e3 for name, summary in clock.measure(runs, effort).items()}
    return {
        "copy_bytes_per_s": 2 * source.nbytes / times["copy"],
        "float32_operations_per_s": 2 * size**3 / times["product"],
        "launch_s": times["tiny"] / 1000,
    }


def host_waits(run: Callable[[], object]) -> dict[str, int]:
    """The lines of code at which the host waits for the GPU during a run, with how often; empty on
    the CPU."""
    if not torch.cuda.is_available():
        return {}
    with warnings.catch_warnings(record=True) as caught, sync_debug_mode("warn"):
        warnings.simplefilter("always")
        run()
    return waits_among(caught)


def waits_among(caught: Iterable[warnings.WarningMessage]) -> dict[str, int]:
    """Of torch's warnings those that tell of a wait: their lines of code, with how often."""
    waits = [w for w in caught if "called a synchronizing" in str(w.message)]
    return dict(Counter(f"{_short(w.filename)}:{w.lineno}" for w in waits).most_common())


def _short(path: str) -> str:
    """The last three parts of a path."""
    return "/".join(Path(path).parts[-3:])


class PeakMemory:
    """The largest memory that tensors took on the device, above what they took when this was
    made."""

    def __init__(self, device: torch.device) -> None:
        self._device = device if device.type == "cuda" else None
        if self._device is not None:
            torch.cuda.reset_peak_memory_stats(self._device)
            self._before = torch.cuda.memory_allocated(self._device)

    def nbytes(self) -> int | None:
        """Bytes; None on the CPU."""
        return (
            None
            if self._device is None
            else torch.cuda.max_memory_allocated(self._device) - self._before
        )
