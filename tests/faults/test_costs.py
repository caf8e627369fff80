"""No file of a stranger takes more than 5 s of processor time and 1 GB of memory for each MB.

The limits here are those of a resource, not of speed: a file within them may take a tenth, and one
that breaks them takes minutes or gigabytes. Processor time is counted, which other programs on the
machine change little, and three times the seconds are allowed.
"""

from __future__ import annotations

import signal
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from PIL import Image

from mrgs.data import images
from mrgs.errors import LONGEST_LINE, MrgsError, MrgsWarning
from tests.faults.costs import Case, text_cases, whole_cases

SECONDS, BYTES = 3 * 5.0, 1e9
"""For each MB of a file."""

PART, WHOLE = 100_000, 1_000_000

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's /proc")
TEXTS, WHOLES = text_cases(), whole_cases()
QUICK = ("JPEG of scans", "YAML of entries", "PNG of counts")
"""Of those that a file of any length may cost, the ones for the short lane."""


def memory(name: str) -> int:
    """Bytes of this process: ``VmRSS`` now, ``VmHWM`` at most since it was last reset."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(name))


@contextmanager
def within(seconds: float, most_bytes: float) -> Iterator[None]:
    """A block that must not take more."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"not within {seconds:g} s")

    Path("/proc/self/clear_refs").write_text("5")
    before, began = memory("VmRSS"), time.process_time()
    usual = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, 2 * seconds)  # what would take hours
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, usual)
    assert time.process_time() - began <= seconds
    assert memory("VmHWM") - before <= most_bytes


def require_little(case: Case, folder: Path, size: int, megabytes: float = 0) -> None:
    """Read a file, or see it refused in one line, within what its bytes, or MB, allow."""
    path = case.make(folder, size)
    megabytes = megabytes or path.stat().st_size / 1e6
    said = ""
    with warnings.catch_warnings(), within(SECONDS * megabytes, BYTES * megabytes):
        warnings.simplefilter("ignore", MrgsWarning)
        try:
            case.read(path)
        except MrgsError as error:
            said = str(error)
    assert said.isprintable()
    assert len(said) < 2 * LONGEST_LINE


@pytest.mark.parametrize("title", TEXTS)
def test_a_part_of_a_megabyte_takes_its_share(title, tmp_path):
    require_little(TEXTS[title], tmp_path, PART)


@pytest.mark.slow
@pytest.mark.parametrize("title", TEXTS)
def test_a_megabyte_takes_no_minutes(title, tmp_path):
    require_little(TEXTS[title], tmp_path, WHOLE)


@pytest.mark.parametrize(
    "title",
    [pytest.param(each, marks=[] if each in QUICK else pytest.mark.slow) for each in WHOLES],
)
def test_few_bytes_take_no_more_than_a_megabyte(title, tmp_path):
    require_little(WHOLES[title], tmp_path, WHOLE, 1.0)


def test_what_takes_too_long_or_too_much_is_noticed():
    with pytest.raises(AssertionError), within(0.01, BYTES), suppress(TimeoutError):
        any(each for each in iter(int, 1))  # for ever
    with pytest.raises(AssertionError), within(SECONDS, 1e6):
        bytearray(b"\1") * 50_000_000


def test_a_signal_behind_the_picture_is_no_scan(tmp_path):
    path = tmp_path / "a.jpg"
    Image.new("RGB", (8, 6), "grey").save(path)
    path.write_bytes(path.read_bytes() + 10_000 * b"\xff\xda")  # raw counts of 56,063
    with images.opened(path, None, ("JPEG",)) as image:
        assert images.as_stored(image).size == (8, 6)
