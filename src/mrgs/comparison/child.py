"""One run in a process of its own: ``python -m mrgs.comparison.child REQUEST``, started by
``processes``.

REQUEST is JSON: ``scene``, ``folder``, ``config`` (YAML), ``device`` and ``lpips_weights`` (a path
or null). The process writes one JSON object per line to its standard output: ``{"step",
"gaussians"}``, ``{"scored", "of"}``, and last ``{"end"}`` ("scored", "stopped" or "error", then
with "message"). When its standard input is closed, it stops with a checkpoint: so it does when the
process that started it dies.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
import warnings
from pathlib import Path
from typing import Any

from mrgs.comparison.methods import from_text
from mrgs.comparison.single import run_one
from mrgs.errors import MrgsError

REPORT_EVERY_S = 1.0


class _StoppedError(Exception):
    """Asked to stop while scoring."""


class Reporter:
    """Says how the run goes, and learns when it must stop."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._last = 0.0
        threading.Thread(target=self._wait_for_end_of_input, daemon=True).start()

    def send(self, **message: Any) -> None:
        """One line for the process that waits."""
        sys.stdout.write(json.dumps(message) + "\n")
        sys.stdout.flush()

    def on_step(self, statistics: Any) -> bool:
        """After each training step; True asks the training to stop."""
        now = time.monotonic()
        if now - self._last >= REPORT_EVERY_S:
            self._last = now
            self.send(step=statistics.step, gaussians=statistics.gaussians)
        return self._stop.is_set()

    def on_score(self, done: int, total: int) -> None:
        """After each scored view."""
        self.send(scored=done, of=total)
        if self._stop.is_set():
            raise _StoppedError

    def _wait_for_end_of_input(self) -> None:
        while os.read(0, 1024):  # not sys.stdin: its lock would be held when the interpreter ends
            pass
        self._stop.set()


def main(request: dict[str, Any]) -> int:
    """Do the run; returns the exit status."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # the parent decides what Ctrl-C means; for systems without sessions
    warnings.simplefilter("ignore")  # the parent has read the same scene and said what was mended
    reporter = Reporter()
    weights = request["lpips_weights"]
    try:
        scored = run_one(
            Path(request["scene"]),
            Path(request["folder"]),
            from_text(request["config"]),
            device=request["device"],
            lpips_weights=None if weights is None else Path(weights),
            on_step=reporter.on_step,
            on_score=reporter.on_score,
        )
    except MrgsError as error:
        reporter.send(end="error", message=str(error))
        return 2
    except _StoppedError:
        scored = False
    reporter.send(end="scored" if scored else "stopped")
    return 0


if __name__ == "__main__":
    sys.exit(main(json.loads(sys.argv[1])))
