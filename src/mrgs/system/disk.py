"""Files that strangers may have made, and free disk space for what a long run will write."""

from __future__ import annotations

import errno
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from mrgs.errors import warn_user

MAX_TEXT_BYTES = 32 * 2**20
"""Longer than any configuration, survey or list of marks."""


@contextmanager
def open_regular(path: Path) -> Iterator[BinaryIO]:
    """A regular file, to be read. OSError for anything else, such as a pipe, which may block."""
    at_once = getattr(os, "O_NONBLOCK", 0)
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | at_once)) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "not a regular file")
        yield file


def read_regular(path: Path, limit: int) -> bytes:
    """The content of a regular file. OSError if unreadable, or of more than ``limit`` bytes."""
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(limit + 1) if size <= limit else b""  # of some files fstat knows no size
    if max(size, len(data)) > limit:
        raise OSError(errno.EFBIG, f"more bytes than the limit of {limit:,}")
    return data


def read_text(path: Path) -> str:
    """The text of a regular file. OSError if it cannot be read, or has more than
    ``MAX_TEXT_BYTES``; UnicodeDecodeError if it is not UTF-8."""
    return read_regular(path, MAX_TEXT_BYTES).decode("utf-8")


def free_disk(folder: Path) -> int:
    """Free bytes on the disk of a folder, which may not be there yet."""
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    return shutil.disk_usage(existing).free


def warn_if_short(folder: Path, needed_bytes: int, what: str) -> None:
    """Compare the room on the disk of a folder, which need not exist yet, with an estimate for
    ``what``, the subject of the sentence; a MrgsWarning if there is less, no error, as the estimate
    may be high."""
    free = free_disk(folder)
    if free < needed_bytes:
        warn_user(
            f"{what} will take about {_size(needed_bytes)}, and the disk of {folder} has "
            f"{_size(free)} left: make room before it is full, or stop and choose another place"
        )


def _size(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"
