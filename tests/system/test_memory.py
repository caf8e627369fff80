from __future__ import annotations

import gc
import subprocess
import sys
from pathlib import Path

import pytest

import mrgs
from mrgs.system.memory import collector_paused, free_memory, peak_resident

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's /proc")


def run_script(script: str) -> int:
    """The number that a script prints in a process of its own."""
    found = subprocess.run(
        [sys.executable, "-c", script],
        cwd=Path(mrgs.__file__).parents[1], capture_output=True, text=True, check=True,
    )  # fmt: skip
    return int(found.stdout)


def test_the_peak_is_not_that_of_the_process_that_started_this_one():
    # This one has loaded torch.
    print_peak = "from mrgs.system.memory import peak_resident; print(peak_resident())"
    assert 2**20 < run_script(print_peak) < 100 * 2**20 < peak_resident()


def test_free_memory_is_some_of_the_machines():
    assert 2**20 < free_memory() < 2**50


def test_large_arrays_go_back_to_the_system_at_once():
    # Freed large arrays raise glibc's limit, so that later ones lie between small ones on the heap.
    script = """
import sys
from mrgs.system.memory import _bytes_after, _STATUS, release_when_freed
release_when_freed()
bytearray(8 << 20)
kept, large = [], []
for _ in range(20):
    large.append(bytearray(b"1") * (4 << 20))
    kept.append(bytearray(b"1") * 60_000)
full = _bytes_after("VmRSS:", _STATUS)
del large
print(full - _bytes_after("VmRSS:", _STATUS))
"""
    assert run_script(script) > 75 * 2**20


def test_what_was_freed_between_arrays_that_stay_is_given_back():
    script = """
from mrgs.system.memory import _bytes_after, _STATUS, give_back_freed
kept, freed = [], []
for _ in range(300):
    freed.append(bytearray(b"1") * 100_000)
    kept.append(bytearray(b"1") * 1_000)
del freed
full = _bytes_after("VmRSS:", _STATUS)
give_back_freed()
print(full - _bytes_after("VmRSS:", _STATUS))
"""
    assert run_script(script) > 20 * 2**20


def test_the_collector_comes_back_after_an_error():
    assert gc.isenabled()

    def fail() -> None:
        with collector_paused():
            assert not gc.isenabled()
            raise ValueError("from within")

    with pytest.raises(ValueError, match="from within"):
        fail()
    assert gc.isenabled()


def test_one_that_is_off_stays_off():
    gc.disable()
    try:
        with collector_paused():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
