"""How much memory the machine has left, and how much this process has used."""

from __future__ import annotations

import sys
from pathlib import Path

_MEMINFO = Path("/proc/meminfo")
_STATUS = Path("/proc/self/status")


def free_memory() -> int | None:
    """Bytes of memory that programs can have without paging; None if the system does not say."""
    return _bytes_after("MemAvailable:", _MEMINFO)


def peak_resident() -> int:
    """Largest resident memory of this process so far, in bytes; 0 if not known."""
    # On Linux, a process inherits the ru_maxrss of the one that started it.
    peak = _bytes_after("VmHWM:", _STATUS)
    if peak is not None:
        return peak
    try:
        import resource
    except ImportError:  # Windows
        return 0
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return used if sys.platform == "darwin" else used * 1024


def _bytes_after(name: str, file: Path) -> int | None:
    """A figure that a file of the system gives in kB, as bytes; None if it does not."""
    try:
        for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith(name):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    return None
