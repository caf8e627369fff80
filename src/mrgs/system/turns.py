"""What only one thread at a time may do, and what Ctrl-C must not leave half done."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class FairLock:
    """A lock that threads get in the order in which they ask for it, also where the one that gives
    it back asks again at once; the thread that holds it may take it again.

    Ctrl-C while a thread waits, or as its turn comes, leaves the lock free for the others.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last = threading.Lock()
        """Held by the thread that asked last, until it is done or has given up."""
        self._holder: int | None = None
        self._held = self._last

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Within this block no other thread holds the lock."""
        if self._holder == threading.get_ident():
            yield
            return
        mine = threading.Lock()
        with mine:  # Python handles no signal between taking a lock in a with and its block
            before, self._last = self._last, mine
            with before:
                pass
            with self._lock:  # the one before may have given up while another thread is at work
                try:
                    self._held = mine
                    # A Ctrl-C that has come meanwhile is raised by this call, within the blocks.
                    self._holder = threading.get_ident()
                    yield
                finally:
                    self._holder = None

    @property
    def is_awaited(self) -> bool:
        """Whether a thread waits for the one that holds the lock."""
        return self._holder is not None and self._held is not self._last


@contextmanager
def ctrl_c_waits() -> Iterator[None]:
    """Within this block Ctrl-C waits for its end; a second one does not.

    Nothing changes where Ctrl-C does something else than to raise KeyboardInterrupt, or in other
    threads than the main one, which it does not reach.

    Raises:
        KeyboardInterrupt: at the end of the block, or at the second Ctrl-C.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    was_pressed = False

    def wait(number: int, frame: object) -> None:
        nonlocal was_pressed
        if was_pressed:
            raise KeyboardInterrupt
        was_pressed = True

    signal.signal(signal.SIGINT, wait)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if was_pressed:
        raise KeyboardInterrupt
