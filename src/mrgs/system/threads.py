"""How many threads compute, processes that lack them because they were forked, what only one thread
at a time may do, and what Ctrl-C must not leave half done."""

from __future__ import annotations

import os
import signal
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

from mrgs.errors import MrgsError


def available_cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0))


def waiting_factor() -> float:
    """How many times as long work on all cores takes if other programs go on as in the last minute:
    1 where they do nothing, or it is not known."""
    try:
        return 1 + os.getloadavg()[0] / (os.cpu_count() or 1)
    except (AttributeError, OSError):  # not everywhere
        return 1.0


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute on the calling thread alone for a while: for small work, threads that wait for each
    other in busy loops take several times the processor time, and are no sooner done where another
    program has a core."""
    import numba
    import torch

    threads = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads[0])
        numba.set_num_threads(threads[1])


_computes: int | None = None
"""The process in which this package first computed; a fork inherits it."""


def require_own_threads() -> None:
    """To be called before something is computed: the threads of torch and Numba do not survive a
    fork, and the child would wait for them forever, or be ended by Numba. MrgsError if this process
    was forked from one that has computed."""
    if _computes not in (None, os.getpid()):
        raise MrgsError(
            "this process was forked from one that has computed, whose threads it lacks: start "
            "processes with multiprocessing.get_context('spawn')"
        )


def will_compute() -> None:
    """To be called where this process begins to train, to load a run or to render: from now on its
    forks must not. Raises as ``require_own_threads``."""
    global _computes
    require_own_threads()
    _computes = os.getpid()


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


@contextmanager
def ctrl_c_waits() -> Iterator[None]:
    """Within this block Ctrl-C waits for its end, where KeyboardInterrupt is raised; a second one
    does not. Nothing changes where Ctrl-C does something else, or in other threads."""
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
