"""Memory: what the machine has left, what this process has used, and how to use less."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_MEMINFO = Path("/proc/meminfo")
_STATUS = Path("/proc/self/status")

_MMAP_THRESHOLD = -3
"""glibc's M_MMAP_THRESHOLD."""

_LARGE_BYTES = 2**20


def free_memory() -> int | None:
    """Bytes of memory that programs can have without paging; None if the system does not say."""
    return _bytes_after("MemAvailable:", _MEMINFO)


def peak_resident() -> int:
    """Largest resident memory of this process so far, in bytes; 0 if not known."""
    # On Linux, a process inherits the ru_maxrss of the one that started it.
    return _bytes_after("VmHWM:", _STATUS) or 0


def release_when_freed() -> None:
    """From now on, let large arrays of this process go back to the system as soon as they are
    freed, where the C library can: else they leave gaps of several hundred MB. For programs that
    make few large arrays, as each costs a call of the system."""
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).mallopt(_MMAP_THRESHOLD, _LARGE_BYTES)


def give_back_freed() -> None:
    """Return the freed memory that the C library keeps in reserve to the system, which takes some
    milliseconds; does nothing where the library cannot."""
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def _bytes_after(name: str, file: Path) -> int | None:
    """A figure that a file of the system gives in kB, as bytes; None if it does not."""
    try:
        for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith(name):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    return None


CHUNK_ROWS = 65_536


def row_chunks(count: int) -> Iterator[slice]:
    """The rows 0 to ``count`` in order, ``CHUNK_ROWS`` at a time; for 0 one empty slice."""
    for start in range(0, max(count, 1), CHUNK_ROWS):
        yield slice(start, min(start + CHUNK_ROWS, count))


@contextmanager
def collector_paused() -> Iterator[None]:
    """Collect no garbage within this block, which makes many objects that stay: again and again the
    collector would look at all of them."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
