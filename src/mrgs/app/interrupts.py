"""What ends a command early: Ctrl-C, a signal, an output that cannot be written.

All of them raise ``Interrupted``, except while a command postpones them, as the training does to
save a checkpoint first. This module is loaded before everything else, so it imports little.
"""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, NamedTuple, cast

CTRL_C = "Ctrl-C"

SIGNALS = {"SIGINT": CTRL_C, "SIGTERM": "SIGTERM", "SIGHUP": "SIGHUP"}
"""Signals that end a command, where the system has them, and their names in messages."""

_IMPORT_MACHINERY = "<frozen importlib._bootstrap>"


class Interruption(NamedTuple):
    """Why a command ends early. ``message`` is the last line on standard error; empty for none."""

    cause: str
    status: int
    message: str


BY_CTRL_C = Interruption(CTRL_C, 130, "mrgs: stopped")


class Interrupted(KeyboardInterrupt):
    """Ends a command early; the interruption is in ``interrupts.received``."""


class Interrupts:
    """Turns signals into ``Interrupted`` while it is entered, in the main thread.

    Signals that the process was started to ignore, as by ``nohup``, stay ignored. ``received`` is
    the first interruption; None if there was none."""

    def __init__(self) -> None:
        self.received: Interruption | None = None
        self._postpone: Callable[[Interruption], None] | None = None
        self._previous: dict[signal.Signals, Any] = {}
        self._depth = 0

    def __enter__(self) -> Interrupts:
        self._depth += 1
        if self._depth == 1 and threading.current_thread() is threading.main_thread():
            self.received = None
            for name in SIGNALS:
                number = getattr(signal, name, None)
                if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        while self._depth == 0 and self._previous:
            number, previous = self._previous.popitem()
            if signal.getsignal(number) == self._on_signal:
                signal.signal(number, previous)

    @contextmanager
    def postponed(self, on_request: Callable[[Interruption], None]) -> Iterator[None]:
        """Within this block the first interruption calls a function and raises nothing.

        Later ones are ignored, because ``timeout`` and service managers repeat their signals; but a
        second Ctrl-C raises ``Interrupted``.
        """
        previous, self._postpone = self._postpone, on_request
        try:
            yield
        finally:
            self._postpone = previous

    def output_lost(self, error: OSError) -> None:
        """Interrupt the command because its standard output cannot be written; from any thread."""
        if self._depth == 0 or self.received is not None:
            return
        if isinstance(error, BrokenPipeError):  # such as that of `mrgs ... | head`
            interruption = Interruption("standard output was closed", 1, "")
        else:
            cause = f"standard output cannot be written ({error.strerror})"
            remedy = "make room, or send it elsewhere"
            interruption = Interruption(cause, 2, f"mrgs: error: {cause}: {remedy}")
        if threading.current_thread() is threading.main_thread():
            self._interrupt(interruption)
        else:
            self.received = interruption
            signal.raise_signal(signal.SIGINT)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        cause = SIGNALS[signal.Signals(number).name]
        if self.received is not None and cause != CTRL_C:
            return
        suffix = "" if cause == CTRL_C else f" ({cause})"
        interruption = Interruption(cause, 128 + number, f"mrgs: stopped{suffix}")
        while frame is not None and frame.f_code.co_filename != _IMPORT_MACHINERY:
            frame = frame.f_back
        if self._postpone is None and frame is not None:
            # Libraries turn an exception in the middle of their import into others.
            with suppress(OSError):
                os.write(2, f"{interruption.message}\n".encode())
            os._exit(interruption.status)
        self._interrupt(interruption)

    def _interrupt(self, interruption: Interruption) -> None:
        is_first, self.received = self.received is None, self.received or interruption
        if not is_first or self._postpone is None:
            raise Interrupted
        self._postpone(interruption)


interrupts = Interrupts()
"""The interruptions of this process."""


def guard_streams(on_lost: Callable[[OSError], None]) -> None:
    """Make the standard streams never raise.

    Streams that are closed are connected to the null device. Characters that an encoding lacks are
    written as escapes. The first write to standard output that fails, because a pipe was closed or
    a disk is full, calls ``on_lost``; later ones do nothing.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this
        if getattr(sys, name) is None:
            stream = os.fdopen(number, "w" if number else "r", closefd=False)
            setattr(sys, name, stream)
            setattr(sys, f"__{name}__", stream)  # a stream that nobody keeps would be closed
    for name, lost in (("stdout", on_lost), ("stderr", lambda error: None)):
        stream = getattr(sys, name)
        if not isinstance(stream, io.TextIOWrapper):  # of a test, a notebook
            continue
        with suppress(OSError, ValueError):
            stream.flush()
            raw = _Guarded(cast(io.RawIOBase, getattr(stream.buffer, "raw", stream.buffer)), lost)
            text = io.TextIOWrapper(
                io.BufferedWriter(raw), stream.encoding, "backslashreplace", line_buffering=True
            )
            setattr(sys, name, text)


class _Guarded(io.RawIOBase):
    """An unbuffered stream; the first write that fails is reported, and later ones do nothing.

    It keeps the stream that Python made: the one of a console on Windows is not a file.
    """

    def __init__(self, stream: io.RawIOBase, on_lost: Callable[[OSError], None]) -> None:
        self._stream, self._on_lost, self._is_lost = stream, on_lost, False
        self.fileno, self.isatty = stream.fileno, stream.isatty  # type: ignore[method-assign]

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int | None:
        if not self._is_lost:
            try:
                return self._stream.write(data)
            except OSError as error:
                self._is_lost = True
                self._on_lost(error)
        return memoryview(data).nbytes
