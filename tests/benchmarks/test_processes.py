from __future__ import annotations

import pytest

from benchmarks.plan import GROUPS, ONE_RUN, SMALLEST
from benchmarks.processes import measure_case

CASE = GROUPS["prototype-avx2"].case(*SMALLEST)
SIZE = {"group": "prototype-avx2", "gaussians": 1_000, "width": 64, "height": 48}


def measured(script: str, threads: int = 2, **options) -> dict:
    """With a script in the place of the child; ``say`` is known in it."""
    say = "import json, os, sys, time\ndef say(**message): print(json.dumps(message), flush=True)\n"
    return measure_case(CASE, ONE_RUN, threads, child=("-c", say + script), **options)


def test_a_result_goes_with_its_case():
    script = """
names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OMP_WAIT_POLICY", "ONEDNN_MAX_CPU_ISA")
say(end="done", result={"peak_bytes": 7, "environment": [os.environ[name] for name in names]})
"""
    environment = ["3", "3", "PASSIVE", "AVX2"]
    expected = {**SIZE, "peak_bytes": 7, "environment": environment}
    assert measured(script, threads=3) == expected


@pytest.mark.parametrize(
    ("script", "reason"),
    [("raise KeyError('x')", "KeyError: 'x'"), ("os.kill(os.getpid(), 9)", "signal 9")],
)
def test_a_child_that_fails_says_why(script, reason):
    result = measured(script)
    assert reason in result.pop("failed")
    assert result == SIZE


def test_a_child_that_does_not_end_is_skipped():
    assert "0.2 s" in measured("time.sleep(600)", timeout_s=0.2)["skipped"]
