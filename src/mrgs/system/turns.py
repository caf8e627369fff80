"""What only one thread at a time may do, and what Ctrl-C must not leave half done."""

from __future__ import annotations

import signal
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager


class FairLock:
    """A lock that threads get in the order in which they ask for it, even if the holder asks again
    at once; the holder may take it again. Ctrl-C leaves it free for the others."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._queue: deque[int] = deque()
        """The thread that has the lock, then those that wait for it."""

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Within this block no other thread has the lock."""
        own, queue = threading.get_ident(), self._queue
        if queue and queue[0] == own:
            yield
            return
        try:
            with self._changed:
                queue.append(own)
                self._changed.wait_for(lambda: queue[0] == own)
            yield
        finally:
            with self._changed:
                if own in queue:
                    queue.remove(own)
                self._changed.notify_all()

    @property
    def is_awaited(self) -> bool:
        """Whether a thread waits for the one that has the lock."""
        return len(self._queue) > 1


@contextmanager
def ctrl_c_waits() -> Iterator[None]:
    """Within this block Ctrl-C waits for its end, where KeyboardInterrupt is raised; a second one
    does not. Nothing changes where Ctrl-C does something else, or in threads other than the main
    one."""
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
