"""Two small fixed kernels that are timed beside every case: how fast, and how loaded, the machine
was just then.

Their times tell whether two figures of one report, or of two reports, were taken under equal
conditions. They are
fixed: whoever changes them makes older reports incomparable.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from benchmarks.timing import Timing

ARITHMETIC = "calibration: arithmetic"
MEMORY = "calibration: memory"

STREAM_FLOATS = 8 * 2**20
"""Two arrays of 32 MiB: no cache holds them both."""

TASKS = 64
"""Far more than threads, so that they share evenly."""

CHAINS = 64
ROUNDS = 60_000
"""64 independent multiply-adds, enough to fill the pipelines, 60,000 times in a row per task."""


@njit(parallel=True, cache=True, error_model="numpy", fastmath={"contract"})
def _multiply_add(chains):  # type: ignore[no-untyped-def]  # float32 [TASKS, CHAINS], stays in the first-level cache
    for task in prange(chains.shape[0]):
        row = chains[task]
        for _ in range(ROUNDS):
            for k in range(CHAINS):
                row[k] = row[k] * np.float32(0.999) + np.float32(0.001)


@njit(parallel=True, cache=True, error_model="numpy")
def _stream(source, target):  # type: ignore[no-untyped-def]  # float32 [STREAM_FLOATS]
    for i in prange(source.size):
        target[i] = target[i] * np.float32(0.5) + source[i]


class Calibration:
    """Both kernels with their arrays; ``nbytes`` is what they add to the process's memory."""

    def __init__(self) -> None:
        chains = np.ones((TASKS, CHAINS), np.float32)
        source, target = np.ones(STREAM_FLOATS, np.float32), np.ones(STREAM_FLOATS, np.float32)
        self.nbytes = source.nbytes + target.nbytes
        self.timings = [
            Timing(ARITHMETIC, lambda _: _multiply_add(chains)),
            Timing(MEMORY, lambda _: _stream(source, target)),
        ]
