from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import mrgs
from mrgs.system.memory import free_memory, peak_resident

PRINT_PEAK = "from mrgs.system.memory import peak_resident; print(peak_resident())"


pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's /proc")


def test_the_peak_is_not_that_of_the_process_that_started_this_one():
    # This one has loaded torch.
    found = subprocess.run(
        [sys.executable, "-c", PRINT_PEAK],
        cwd=Path(mrgs.__file__).parents[1], capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert 2**20 < int(found.stdout) < 100 * 2**20 < peak_resident()


def test_free_memory_is_some_of_the_machines():
    assert 2**20 < free_memory() < 2**50
