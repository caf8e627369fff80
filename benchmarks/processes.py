"""Each case in a process of its own, so that its peak memory is its own."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.plan import GROUPS, ONE_RUN, SMALLEST, Case, Effort

ROOT = Path(__file__).parents[1]
TIMEOUT_S = 300


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
    # Threads that spin while they wait would starve those of the other of the two pools, torch's
    # and Numba's.
    counts = {
        "OMP_NUM_THREADS": str(threads),
        "NUMBA_NUM_THREADS": str(threads),
        "OMP_WAIT_POLICY": "PASSIVE",
    }
    try:
        child = subprocess.run(
            [sys.executable, "-m", "benchmarks.child", json.dumps(request)],
            cwd=ROOT, env={**os.environ, **counts, **variables}, capture_output=True, text=True,
            timeout=TIMEOUT_S,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return {"skipped": f"not done after {TIMEOUT_S} s"}
    if child.returncode != 0:
        lines = child.stderr.strip().splitlines() or [f"exit status {child.returncode}"]
        return {"failed": lines[-1]}
    result: dict[str, Any] = json.loads(child.stdout)
    return result
