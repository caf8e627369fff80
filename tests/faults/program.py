"""The program in a process of its own, as users start it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.helpers.scenes import write_scene

SOURCE = Path(__file__).parents[2] / "src"
SMALL = ("--preset", "fast", "--max-gaussians", 100)


@dataclass(frozen=True)
class Ended:
    """A process that has ended: its exit status (negative for a signal) and what it printed."""

    status: int
    out: str
    err: str

    @property
    def is_clean(self) -> bool:
        """Neither a traceback nor a signal ended it."""
        return self.status >= 0 and "Traceback" not in self.out + self.err

    @property
    def is_refusal(self) -> bool:
        """It ended with one line that names the error."""
        lines = [line for line in self.err.splitlines() if line.startswith("mrgs: error: ")]
        return self.is_clean and self.status == 2 and len(lines) == 1

    def __str__(self) -> str:
        last = [*self.err.strip().splitlines(), *self.out.strip().splitlines(), ""][0]
        return f"exit {self.status}, {last[:150]!r}"


def environment(**changes: str) -> dict[str, str]:
    """This process's environment with one thread, changed."""
    path = os.pathsep.join([str(SOURCE), os.environ.get("PYTHONPATH", "")])
    threads = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    return {**os.environ, **threads, "PYTHONPATH": path.rstrip(os.pathsep), **changes}


def start(*arguments: object, shell: str = 'exec "$@"', **options: Any) -> subprocess.Popen[str]:
    """Start the program.

    Args:
        arguments: of the program.
        shell: script that starts its arguments, such as one that closes a stream first.
        options: of ``Popen``.
    """
    command = [sys.executable, "-m", "mrgs", *map(str, arguments)]
    return subprocess.Popen(
        ["sh", "-c", shell, "sh", *command],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        errors="replace", env=environment(**options.pop("variables", {})),
        preexec_fn=_as_in_a_terminal, **options,
    )  # fmt: skip


def ended(process: subprocess.Popen[str], timeout_s: float = 300) -> Ended:
    """Wait for the end of a process; one that takes too long is killed."""
    try:
        out, err = process.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = process.communicate()
    return Ended(process.returncode, out, err)


def run(*arguments: object, **options: Any) -> Ended:
    """Start the program, and wait for its end."""
    return ended(start(*arguments, **options))


def wait_until(
    test: Callable[[], bool], process: subprocess.Popen[str], seconds: float = 300
) -> bool:
    """Wait for something that a process brings about; False if it has ended, or never does."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if test():
            return True
        if process.poll() is not None:
            return False
        time.sleep(0.02)
    return False


def logged_step(run_folder: Path) -> int:
    """The last step in a run's log; 0 without one."""
    try:
        lines = (run_folder / "log.jsonl").read_text().splitlines()
        return max(json.loads(line)["step"] for line in lines)
    except (OSError, ValueError):
        return 0


def small_scene(folder: Path) -> Path:
    """A scene that a step takes milliseconds for; made once."""
    return folder if folder.exists() else write_scene(folder)


def photos_of(scene: Path, folder: Path) -> tuple[object, ...]:
    """Arguments of ``mrgs prepare`` for the photos of a scene, but for the folder to make."""
    for name, source in (("rgb", "images"), ("thermal", "thermal")):
        (folder / name).mkdir(parents=True, exist_ok=True)
        for photo in (scene / source).glob("*.png"):
            (folder / name / photo.name).write_bytes(photo.read_bytes())
    return folder, "--poses", scene, "--one-camera", "--bounds", 10, 30


def _as_in_a_terminal() -> None:
    """A background shell leaves Ctrl-C ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
