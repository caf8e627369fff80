"""One run in a process of its own: ``python -m mrgs_compare.child REQUEST``, started by
``processes`` with the protocol of ``mrgs.system.child``.

The request has ``scene``, ``folder``, ``config`` (YAML), ``device`` and ``lpips_weights`` (a path
or null); messages are ``{"step", "gaussians"}``, ``{"scored", "of"}`` and ``{"warning"}``; the end
is "scored", "stopped" or an error. Asked to stop, a training writes a checkpoint first, and all
else stops at once."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from mrgs.errors import KernelWarning, MrgsError
from mrgs.system.child import read_request, send, when_asked_to_stop
from mrgs_compare.plan import from_text, run_one

REPORT_EVERY_S = 1.0

REQUESTS = ("SIGTERM", "SIGHUP")
"""Signals that ask the process to stop, where the system has them."""


class _StoppedError(KeyboardInterrupt):
    """A request to stop came while there was nothing to save."""


class Reporter:
    """Reports the progress of the run, and stops it on request."""

    def __init__(self, listen: Callable[[Callable[[], None]], None]) -> None:
        self._stop = threading.Event()
        self._trains = False
        self._last = 0.0

        def on_signal(*_: object) -> None:
            self._stop.set()
            if not self._trains:
                raise _StoppedError

        def ask_to_stop() -> None:  # from another thread: the main thread handles it as a signal
            self._stop.set()
            _thread.interrupt_main(signal.SIGTERM)

        for name in REQUESTS:
            if hasattr(signal, name):
                signal.signal(getattr(signal, name), on_signal)
        listen(ask_to_stop)

    def on_step(self, statistics: Any) -> bool:
        """Called after each training step; returns True to stop the training."""
        self._trains = True
        now = time.monotonic()
        if now - self._last >= REPORT_EVERY_S:
            self._last = now
            send(step=statistics.step, gaussians=statistics.gaussians)
        return self._stop.is_set()

    def on_score(self, done: int, total: int) -> None:
        """Called after each scored view."""
        self._trains = False
        send(scored=done, of=total)
        if self._stop.is_set():
            raise _StoppedError


def main(
    request: dict[str, Any],
    run: Callable[..., bool] = run_one,
    listen: Callable[[Callable[[], None]], None] = when_asked_to_stop,
) -> int:
    """Train and score the run of a request; returns the exit status."""
    # The parent decides what Ctrl-C means, also on systems without sessions.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter("ignore")  # the parent has read the same scene and shown its warnings
    warnings.simplefilter("always", KernelWarning)
    warnings.showwarning = cast(Any, lambda message, *_, **__: send(warning=str(message)))
    weights = request["lpips_weights"]
    try:
        reporter = Reporter(listen)
        scored = run(
            Path(request["scene"]),
            Path(request["folder"]),
            from_text(request["config"]),
            device=request["device"],
            lpips_weights=None if weights is None else Path(weights),
            on_step=reporter.on_step,
            on_score=reporter.on_score,
        )
    except MrgsError as error:
        send(end="error", message=str(error))
        return 2
    except _StoppedError:
        scored = False
    send(end="scored" if scored else "stopped")
    return 0


if __name__ == "__main__":
    sys.exit(main(read_request()))
