"""Child processes that report on their work: the one protocol for all of them.

A child is a Python process that imports nothing from the user's folders
(``child_environment``). Its argument is a JSON request. It writes one JSON object per line to its
standard output, and last one with the key ``end``, which says how the work ended;
``{"end": "error", "message": ...}`` is a failure that it understands. When its standard input is
closed, its parent wants it to stop, or has died. Standard error goes to a log file.

Children are started with an argv: ``multiprocessing`` would pickle what it hands over, and run the
caller's script again in each of them.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

Message = dict[str, Any]

OUT_OF_MEMORY = "the system ended the process (signal 9), most likely for want of memory"


class Child:
    """A child process, as its parent sees it; ``end`` is its last message, empty before."""

    def __init__(self, arguments: Sequence[str], request: Any, log: Path, **variables: str) -> None:
        """Start Python in a session of its own, so that Ctrl-C reaches the parent alone. The
        ``arguments`` are such as ``("-m", "package.module")``, the ``request`` anything that JSON
        can express, ``variables`` changes of the environment."""
        self.log = log
        self.end: Message = {}
        # Threads that spin while they wait would starve those that work.
        environment = child_environment(**{"OMP_WAIT_POLICY": "PASSIVE", **variables})
        with log.open("w", encoding="utf-8") as errors:
            self._process = subprocess.Popen(
                [sys.executable, *arguments, json.dumps(request)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors,
                encoding="utf-8", errors="replace",
                env=environment, cwd=CHILD_FOLDER, start_new_session=True,
            )  # fmt: skip

    def messages(self) -> Iterator[Message]:
        """All messages but the last, as they come; returns when the process has ended."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            try:
                message = json.loads(line)
            except ValueError:  # a library that prints
                continue
            if isinstance(message, dict):
                if "end" in message:
                    self.end = message
                else:
                    yield message
        self._process.wait()

    def stop(self) -> None:
        """Ask the process to stop."""
        assert self._process.stdin is not None
        self._process.stdin.close()

    def kill(self) -> None:
        """End the process at once, from any thread; does nothing if it has ended."""
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        """End the process at once and close its pipes."""
        self.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()

    def failure(self) -> str | None:
        """Why the process, which has ended, did not do its work; None if it did or was stopped."""
        if self.end.get("end") == "error":
            return str(self.end["message"])
        status = self._process.returncode
        if status == 0 and self.end:
            return None
        if status == -9:
            return OUT_OF_MEMORY
        errors = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return f"the process ended with status {status} ({[*errors[-1:], 'no message'][0]})"


def send(**message: Any) -> None:
    """Send a message from a child to its parent; does nothing if the parent has died."""
    try:
        sys.stdout.write(json.dumps(message) + "\n")
        sys.stdout.flush()
    except OSError:
        # What is left in the buffer must not raise again when the process ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def read_request() -> Any:
    """The request of this child process."""
    return json.loads(sys.argv[1])


def when_asked_to_stop(action: Callable[[], None]) -> None:
    """In a child, do something once its parent wants it to stop or has died. Standard input becomes
    the null device: on Windows a library being loaded would wait for the thread that reads it."""
    parent = os.dup(0)
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)

    def wait() -> None:
        while os.read(parent, 1024):
            pass
        action()

    threading.Thread(target=wait, daemon=True).start()


CHILD_FOLDER = Path(sys.prefix)
"""Where a child runs. ``python -m`` puts the current folder first on ``sys.path``, so that a
``json.py`` among downloaded photos would be run; Python 3.10 does not know PYTHONSAFEPATH."""


def child_environment(**changes: str) -> dict[str, str]:
    """This process's environment with changes; PYTHONPATH means the same folders as here."""
    environment = {**os.environ, "PYTHONSAFEPATH": "1", **changes}
    # An empty entry is the current folder, and most often there by mistake.
    entries = [
        os.path.abspath(entry)
        for entry in environment.pop("PYTHONPATH", "").split(os.pathsep)
        if entry
    ]
    if entries:
        environment["PYTHONPATH"] = os.pathsep.join(entries)
    return environment
