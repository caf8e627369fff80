"""Resident memory of this process, now and at its peak."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path

from mrgs.run_files.record import peak_memory_bytes

_STATUS = Path("/proc/self/status")


def resident_bytes() -> int:
    """Resident memory now; where the system does not tell, the peak so far."""
    return _from_status("VmRSS") or peak_memory_bytes()


def peak_bytes() -> int:
    """Largest resident memory since ``reset_peak``; where that cannot be had, since the process
    began."""
    return _from_status("VmHWM") or peak_memory_bytes()


def reset_peak() -> None:
    """Forget the peak of the imports. Linux alone can do this."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def limit_address_space(limit_bytes: int) -> None:
    """Let allocations beyond the limit fail instead of pushing other programs out of memory."""
    if sys.platform == "linux":
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (limit_bytes, limit_bytes))


def _from_status(key: str) -> int:
    with suppress(OSError):
        for line in _STATUS.read_text().splitlines():
            if line.startswith(f"{key}:"):
                return 1024 * int(line.split()[1])
    return 0
