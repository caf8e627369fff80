"""The one thread on which a viewer uses its model."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Hashable
from concurrent.futures import CancelledError

_log = logging.getLogger(__name__)

Job = Callable[[], None]


class Worker:
    """One thread that does the jobs of all browsers in turn.

    A job that waits is replaced by a newer one with the same key: of a camera that moves, only the
    newest place is drawn.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._jobs: dict[Hashable, Job] = {}
        self._working = False
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="mrgs-viewer", daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether a job is due, or being done."""
        with self._changed:
            return self._working or bool(self._jobs)

    def put(self, key: Hashable, job: Job) -> None:
        """Do a job after those that wait already, in place of the waiting one with its key."""
        with self._changed:
            if not self._closed:
                self._jobs[key] = job
                self._changed.notify()

    def drop(self, keys: Callable[[Hashable], bool]) -> None:
        """Forget the waiting jobs whose keys fit."""
        with self._changed:
            self._jobs = {key: job for key, job in self._jobs.items() if not keys(key)}

    def close(self) -> None:
        """Forget all jobs, and end the thread after the one that it is doing; does not wait."""
        with self._changed:
            self._closed = True
            self._jobs.clear()
            self._changed.notify()

    def join(self, timeout_s: float) -> None:
        """Wait until the thread has ended, at most for some seconds."""
        self._thread.join(timeout_s)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._working = False
                self._changed.wait_for(lambda: self._closed or self._jobs)
                if self._closed:
                    return
                job = self._jobs.pop(next(iter(self._jobs)))
                self._working = True
            try:
                job()
            except CancelledError:  # the training has ended
                self.close()
            except Exception:
                _log.warning("the viewer failed", exc_info=True)
