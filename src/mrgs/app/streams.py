"""Standard streams that never raise: whatever is printed, and wherever it goes.

A name that the output's encoding lacks is written with escapes. A write that fails, because a pipe
was closed or a disk is full, is reported once; what follows is dropped.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any, cast

OnLost = Callable[[OSError], None]


def open_missing_streams() -> None:
    """Connect the standard streams that the process was started without to the null device.

    Otherwise the next file that is opened would get their number, and what is printed would be
    written into it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if not _is_open(number):
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))


def _is_open(descriptor: int) -> bool:
    try:
        os.fstat(descriptor)
    except OSError:
        return False
    return True


def guard_streams(on_lost: OnLost) -> None:
    """Guard standard output and standard error; ``on_lost`` is called if the output is lost."""
    for name, lost in (("stdout", on_lost), ("stderr", lambda error: None)):
        stream = getattr(sys, name)
        if not isinstance(stream, io.TextIOWrapper):  # of a test, a notebook
            continue
        with suppress(OSError, ValueError):
            stream.flush()
            raw = _Guarded(cast(io.RawIOBase, getattr(stream.buffer, "raw", stream.buffer)), lost)
            guarded = io.TextIOWrapper(
                io.BufferedWriter(raw),
                encoding=stream.encoding,
                errors="backslashreplace",
                line_buffering=True,
                write_through=stream.write_through,
            )
            setattr(sys, name, guarded)


class _Guarded(io.RawIOBase):
    """An unbuffered stream; the first write that fails is reported, and later ones do nothing.

    It keeps the stream that Python made: that of a console on Windows is no file.
    """

    def __init__(self, stream: io.RawIOBase, on_lost: OnLost) -> None:
        self._stream = stream
        self._on_lost = on_lost
        self._is_lost = False

    def writable(self) -> bool:
        """It is, as ``io.BufferedWriter`` asks."""
        return True

    def fileno(self) -> int:
        """The file descriptor of the stream."""
        return self._stream.fileno()

    def isatty(self) -> bool:
        """Whether the stream is a terminal."""
        return self._stream.isatty()

    def write(self, data: Any) -> int | None:
        """Write bytes; pretends to have done so once the stream is lost."""
        if not self._is_lost:
            try:
                return self._stream.write(data)
            except OSError as error:
                self._is_lost = True
                self._on_lost(error)
        return memoryview(data).nbytes
