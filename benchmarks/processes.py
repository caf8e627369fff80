"""Each case in a process of its own, so that its peak memory is its own."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Timer
from typing import Any

from benchmarks.plan import GROUPS, ONE_RUN, SMALLEST, Case, Effort
from mrgs.system.child import Child

ROOT = Path(__file__).parents[1]
CHILD = ("-m", "benchmarks.child")
TIMEOUT_S = 300.0


def measure_case(case: Case, effort: Effort, threads: int) -> dict[str, Any]:
    """The case's fields with "timings", "peak_bytes" and "notes", or with the reason why it was
    "skipped"."""
    return {
        **dataclasses.asdict(case),
        **_run([case], effort, threads, GROUPS[case.group].environment),
    }


def warm_up(groups: Sequence[str], threads: int) -> None:
    """Compile what the groups need, so that no case holds the compiler's memory."""
    _run([GROUPS[name].case(*SMALLEST) for name in groups], ONE_RUN, threads, {})


def _run(
    cases: Sequence[Case], effort: Effort, threads: int, variables: dict[str, str]
) -> dict[str, Any]:
    """Start the child and read its answer."""
    request = {
        "cases": [dataclasses.asdict(case) for case in cases],
        "effort": dataclasses.asdict(effort),
        "threads": threads,
    }
    counts = {"OMP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}
    paths = (str(ROOT), os.environ.get("PYTHONPATH", ""))
    with TemporaryDirectory() as folder:
        child = Child(
            CHILD, request, Path(folder) / "log.txt",
            PYTHONPATH=os.pathsep.join(filter(None, paths)), **counts, **variables,
        )  # fmt: skip
        late = Event()

        def end() -> None:
            late.set()
            child.kill()

        timer = Timer(TIMEOUT_S, end)
        timer.start()
        try:
            for _ in child.messages():
                pass
        finally:
            timer.cancel()
            child.close()
        reason = child.failure()
    if late.is_set():
        return {"skipped": f"not done after {TIMEOUT_S} s"}
    return {"failed": reason} if reason is not None else child.end["result"]
