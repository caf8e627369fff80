"""Free disk space, and whether it is enough for what a long run will write."""

from __future__ import annotations

import shutil
from pathlib import Path

from mrgs.errors import warn_user


def free_disk(folder: Path) -> int:
    """Free bytes on the disk of a folder, which may not be there yet."""
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    return shutil.disk_usage(existing).free


def warn_if_short(folder: Path, needed_bytes: int, what: str) -> None:
    """Compare the room on the disk of a folder, which need not exist yet, with an estimate of what
    will be written there; ``what`` is the subject of the sentence.

    Too little room is no error: the estimate may be too high, and what is written before the disk
    is full is kept. MrgsWarning if there is less."""
    free = free_disk(folder)
    if free < needed_bytes:
        warn_user(
            f"{what} will take about {_size(needed_bytes)}, and the disk of {folder} has "
            f"{_size(free)} left: make room before it is full, or stop and choose another place"
        )


def _size(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"
