from __future__ import annotations

import json
import subprocess

import pytest
from benchmarks.plan import GROUPS, ONE_RUN, SMALLEST
from benchmarks.processes import measure_case

from benchmarks import processes

CASE = GROUPS["prototype-avx2"].case(*SMALLEST)
SIZE = {"group": "prototype-avx2", "gaussians": 1_000, "width": 64, "height": 48}


def child_that(monkeypatch, returncode: int = 0, stdout: str = "", stderr: str = "") -> list[dict]:
    """Replaces the child; returns the keyword arguments it is started with."""
    started = []

    def run(command, **options):
        started.append(options)
        return subprocess.CompletedProcess(command, returncode, stdout, stderr)

    monkeypatch.setattr(processes.subprocess, "run", run)
    return started


def test_a_result_goes_with_its_case(monkeypatch):
    started = child_that(monkeypatch, stdout=json.dumps({"peak_bytes": 7}))
    assert measure_case(CASE, ONE_RUN, threads=3) == {**SIZE, "peak_bytes": 7}
    environment = started[0]["env"]
    assert (environment["NUMBA_NUM_THREADS"], environment["OMP_NUM_THREADS"]) == ("3", "3")
    assert environment["ONEDNN_MAX_CPU_ISA"] == "AVX2"


@pytest.mark.parametrize(
    ("stderr", "reason"), [("Traceback\nKeyError: x\n", "KeyError: x"), ("", "exit status -9")]
)
def test_a_child_that_fails_says_why(monkeypatch, stderr, reason):
    child_that(monkeypatch, returncode=-9, stderr=stderr)
    assert measure_case(CASE, ONE_RUN, threads=2) == {**SIZE, "failed": reason}


def test_a_child_that_does_not_end_is_skipped(monkeypatch):
    def run(command, timeout, **options):
        raise subprocess.TimeoutExpired(command, timeout)

    monkeypatch.setattr(processes.subprocess, "run", run)
    assert "not done" in measure_case(CASE, ONE_RUN, threads=2)["skipped"]
