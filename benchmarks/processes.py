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


def measure_case(
    case: Case,
    effort: Effort,
    threads: int,
    child: Sequence[str] = CHILD,
    timeout_s: float = TIMEOUT_S,
) -> dict[str, Any]:
    """The case's fields with "timings", "peak_bytes" and "notes", or with the reason why it was
    "skipped"."""
    variables = GROUPS[case.group].environment
    return {
        **dataclasses.asdict(case),
        **_run([case], effort, threads, variables, child, timeout_s),
    }


def warm_up(groups: Sequence[str], threads: int) -> None:
    """Compile what the groups need, so that no case holds the compiler's memory."""
    _run([GROUPS[name].case(*SMALLEST) for name in groups], ONE_RUN, threads, {})


def _run(
    cases: Sequence[Case],
    effort: Effort,
    threads: int,
    variables: dict[str, str],
    arguments: Sequence[str] = CHILD,
    timeout_s: float = TIMEOUT_S,
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
            arguments, request, Path(folder) / "log.txt",
            PYTHONPATH=os.pathsep.join(filter(None, paths)), **counts, **variables,
        )  # fmt: skip
        late = Event()

        def end() -> None:
            late.set()
            child.kill()

        timer = Timer(timeout_s, end)
        timer.start()
        try:
            for _ in child.messages():
                pass
        finally:
            timer.cancel()
            child.close()
        reason = child.failure()
    if late.is_set():
        return {"skipped": f"not done after {timeout_s} s"}
    return {"failed": reason} if reason is not None else child.end["result"]
