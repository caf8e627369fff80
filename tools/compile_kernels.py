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
METHODS = ("mrgs-plus", "mrgs", "thermonerf")
"""Between them, these run every kernel of a training; the scores of one run the others."""


def mrgs(*arguments: str) -> None:
    """Run a command of the program in silence."""
    command = [sys.executable, "-m", "mrgs", *arguments]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def compile_kernels(stamp: Path) -> None:
    """Train each method for two steps and score one of them, unless another process did so while
    this one waited."""
    began = time.time()
    with FileLock(f"{stamp}.lock"), tempfile.TemporaryDirectory() as folder:
        if stamp.exists() and stamp.stat().st_mtime > began:
            return
        for method in METHODS:
            options = ("--method", method, "--max-steps", "2", "--output", f"{folder}/{method}")
            mrgs("train", str(SCENE), *options)
        mrgs("eval", f"{folder}/{METHODS[0]}")
        stamp.touch()


if __name__ == "__main__":
    compile_kernels(Path(sys.argv[1]))
