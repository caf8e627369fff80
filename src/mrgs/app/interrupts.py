"""What ends a command early: Ctrl-C, a request of the system, an output that cannot be written.

All of them raise ``Interrupted``, except while a command postpones them, as the training does to
save a checkpoint first. This module is loaded before everything else, so it imports little.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, NamedTuple

CTRL_C = "Ctrl-C"

SIGNALS = {"SIGINT": CTRL_C, "SIGTERM": "SIGTERM", "SIGHUP": "SIGHUP", "SIGBREAK": "Ctrl-Break"}
"""Signals that end a command, as far as the system knows them, and what messages call them."""

_IMPORT_MACHINERY = "<frozen importlib._bootstrap>"


class Interruption(NamedTuple):
    """Why a command ends early.

    Attributes:
        cause: what messages call it.
        status: exit status of the process.
        message: last line on standard error; empty for none.
    """

    cause: str
    status: int
    message: str


BY_CTRL_C = Interruption(CTRL_C, 130, "mrgs: stopped")


class Interrupted(KeyboardInterrupt):
    """Ends a command early; the interruption is in ``interrupts.received``."""


class Interrupts:
    """Turns signals into ``Interrupted`` while it is entered, in the main thread.

    Signals that the process was started to ignore, as by ``nohup``, stay ignored.

    Attributes:
        received: the first interruption; None as long as there is none.
    """

    def __init__(self) -> None:
        self.received: Interruption | None = None
        self._postpone: Callable[[Interruption], None] | None = None
        self._previous: dict[signal.Signals, Any] = {}
        self._depth = 0
        self._unraisable = sys.unraisablehook

    def __enter__(self) -> Interrupts:
        self._depth += 1
        if self._depth == 1 and threading.current_thread() is threading.main_thread():
            self.received = None
            self._unraisable, sys.unraisablehook = sys.unraisablehook, self._when_swallowed
            for name in SIGNALS:
                number = getattr(signal, name, None)
                if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if self._depth == 0 and self._previous:
            sys.unraisablehook = self._unraisable
            while self._previous:
                signal.signal(*self._previous.popitem())

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

    def command_is_done(self) -> None:
        """From now on ignore requests to end, except for Ctrl-C: the process ends anyway, with the
        status of its command."""
        for number in [number for number in self._previous if number != signal.SIGINT]:
            del self._previous[number]
            signal.signal(number, signal.SIG_IGN)

    def output_lost(self, error: OSError) -> None:
        """Interrupt the command, because its standard output cannot be written; from any thread."""
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
        name = signal.Signals(number).name
        cause = SIGNALS[name]
        suffix = "" if cause == CTRL_C else f" ({cause})"
        if self.received is not None and cause != CTRL_C:
            return
        interruption = Interruption(cause, 128 + number, f"mrgs: stopped{suffix}")
        if self._postpone is None and _is_importing(frame):
            # Libraries turn an exception in the middle of their import into others.
            self._leave(interruption)
        self._interrupt(interruption)

    def _interrupt(self, interruption: Interruption) -> None:
        is_first, self.received = self.received is None, self.received or interruption
        if is_first and self._postpone is not None:
            self._postpone(interruption)
            return
        raise Interrupted

    def _when_swallowed(self, unraisable: Any) -> None:
        """Python drops exceptions in destructors and callbacks; an interruption must not be."""
        if issubclass(unraisable.exc_type, Interrupted) and self.received is not None:
            self._leave(self.received)
        self._unraisable(unraisable)

    def _leave(self, interruption: Interruption) -> None:
        """End the process at once."""
        with suppress(Exception):
            sys.stdout.flush()
        if interruption.message:
            with suppress(OSError):
                os.write(2, f"{interruption.message}\n".encode())
        os._exit(interruption.status)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == _IMPORT_MACHINERY:
            return True
        frame = frame.f_back
    return False


interrupts = Interrupts()
"""The interruptions of this process."""
