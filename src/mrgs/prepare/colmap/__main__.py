"""The process: what ``mrgs.prepare.colmap`` says."""

from __future__ import annotations

import json
import os
import shutil
import sys
import threading
from pathlib import Path
from typing import Any

from mrgs.prepare.colmap.job import read_job

LEAST_FREE_BYTES = 50 * 2**20


def send(**message: Any) -> None:
    """One line for the process that waits."""
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


def report(step: str, done: int, of: int) -> None:
    """How far a step is."""
    send(step=step, done=done, of=of)


def main(folder: Path) -> int:
    """Do what is left of the job; returns the exit status."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        from mrgs.prepare.colmap.features import find_features
        from mrgs.prepare.colmap.mapping import map_images
        from mrgs.prepare.colmap.matching import match

        job = read_job(folder)
        find_features(job, report)
        match(job, report)
        map_images(job, report)
    except Exception as error:  # pycolmap's are of many types, and the parent has only these lines
        full = shutil.disk_usage(folder).free < LEAST_FREE_BYTES
        send(
            end="error",
            message="the disk is full"
            if full
            else " ".join(f"{type(error).__name__}: {error}".split()),
        )
        return 1
    send(end="done")
    return 0


def _end_with_parent() -> None:
    while os.read(0, 1024):  # not sys.stdin: its lock would be held when the interpreter ends
        pass
    # Nothing is lost: the database has transactions, and the model is moved when it is complete.
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
