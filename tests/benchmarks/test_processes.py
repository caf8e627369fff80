from __future__ import annotations

import pytest

from benchmarks import processes
from benchmarks.plan import GROUPS, ONE_RUN, SMALLEST
from benchmarks.processes import measure_case

CASE = GROUPS["prototype-avx2"].case(*SMALLEST)
SIZE = {"group": "prototype-avx2", "gaussians": 1_000, "width": 64, "height": 48}


@pytest.fixture
def child(monkeypatch):
    """Puts a script in the place of the child; ``say`` is known in it."""
    say = "import json, os, sys, time\ndef say(**message): print(json.dumps(message), flush=True)\n"
    return lambda script: monkeypatch.setattr(processes, "CHILD", ("-c", say + script))


def test_a_result_goes_with_its_case(child):
    child("""
names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OMP_WAIT_POLICY", "ONEDNN_MAX_CPU_ISA")
say(end="done", result={"peak_bytes": 7, "environment": [os.environ[name] for name in names]})
""")
    environment = ["3", "3", "PASSIVE", "AVX2"]
    expected = {**SIZE, "peak_bytes": 7, "environment": environment}
    assert measure_case(CASE, ONE_RUN, threads=3) == expected


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("raise KeyError('x')", "the process ended with status 1 (KeyError: 'x')"),
        ("os.kill(os.getpid(), 9)", "the system ended the process (signal 9)"),
    ],
)
def test_a_child_that_fails_says_why(child, script, reason):
    child(script)
    result = measure_case(CASE, ONE_RUN, threads=2)
    assert result.pop("failed").startswith(reason)
    assert result == SIZE


def test_a_child_that_does_not_end_is_skipped(child, monkeypatch):
    monkeypatch.setattr(processes, "TIMEOUT_S", 0.2)
    child("time.sleep(600)")
    assert "not done" in measure_case(CASE, ONE_RUN, threads=2)["skipped"]
