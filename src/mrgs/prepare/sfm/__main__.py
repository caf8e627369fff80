"""The process in which pycolmap runs; see ``mrgs.prepare.sfm``."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

from mrgs.prepare.sfm.job import read_job
from mrgs.system.child import read_request, send, when_asked_to_stop

LEAST_FREE_BYTES = 50 * 2**20


def report(step: str, done: int, of: int) -> None:
    """Send the progress of a step."""
    send(step=step, done=done, of=of)


def main(folder: Path) -> int:
    """Complete the job; returns the exit status."""
    # Nothing is lost: the database has transactions, and the model is moved when it is complete.
    when_asked_to_stop(lambda: os._exit(1))
    try:
        from mrgs.prepare.sfm.mapping import adjust, find_features, map_images, match

        job = read_job(folder)
        find_features(job, report)
        match(job, report)
        map_images(job, report)
        adjust(job, report)
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


if __name__ == "__main__":
    sys.exit(main(Path(read_request())))
