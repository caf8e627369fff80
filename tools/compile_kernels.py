"""Compile the Numba kernels once, before several test processes would each compile them.

``python tools/compile_kernels.py STAMP`` touches the file STAMP when all are compiled. They are
kept on disk (``mrgs.kernels.cache``); where they are kept already, this takes some seconds.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from filelock import FileLock

SCENE = Path(__file__).parents[1] / "examples" / "tabletop"


def start(*arguments: str) -> subprocess.Popen:
    """Run a command of the program in silence."""
    return subprocess.Popen([sys.executable, "-m", "mrgs", *arguments], stdout=subprocess.DEVNULL)


def start_training(method: str, runs: str) -> subprocess.Popen:
    """Two steps on photos so small that nearly all of their time is compiling."""
    options = ("--max-steps", "2", "--resolution", "32", "--output", f"{runs}/{method}")
    return start("train", str(SCENE), "--method", method, *options)


def wait(process: subprocess.Popen) -> None:
    """RuntimeError if it failed."""
    if process.wait():
        raise RuntimeError(f"{process.args!r} failed")


def compile_kernels(stamp: Path) -> None:
    """Train three methods, which between them run every kernel of a training, and score a run,
    which runs the others; unless another process did so while this one waited. What shares kernels
    follows one another, all else runs beside it."""
    began = time.time()
    with FileLock(f"{stamp}.lock"), tempfile.TemporaryDirectory() as runs:
        if stamp.exists() and stamp.stat().st_mtime > began:
            return
        baseline = start_training("thermonerf", runs)
        wait(start_training("mrgs-plus", runs))
        scores = start("eval", f"{runs}/mrgs-plus")
        wait(start_training("mrgs", runs))
        for each in (baseline, scores):
            wait(each)
        stamp.touch()


if __name__ == "__main__":
    compile_kernels(Path(sys.argv[1]))
