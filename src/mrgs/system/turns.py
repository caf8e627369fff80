"""What only one thread at a time may do."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager


class Turns:
    """A lock that a waiting thread gets when it is next given back, also from a thread that would
    take it again at once; the thread that holds it may take it again."""

    def __init__(self) -> None:
        self._door, self._lock = threading.Lock(), threading.Lock()
        self._holder: int | None = None

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Within this block no other thread holds the lock."""
        own = threading.get_ident()
        if self._holder == own:
            yield
            return
        with self._door:  # whoever waits for the lock holds it, so that nobody overtakes
            self._lock.acquire()
        self._holder = own
        try:
            yield
        finally:
            self._holder = None
            self._lock.release()
