"""What is to be reconstructed."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

Report = Callable[[str, int, int], None]
"""Called with a step's name, and how many of its parts are done and there are."""

JOB_FILE = "job.json"
IMAGE_FOLDER = "images"
MODEL_FOLDER = "model"
POINTS_FILE = "points.npz"
REPORT_FILE = "report.json"


@dataclass(frozen=True)
class Job:
    """Images in the order in which they were taken.

    Attributes:
        folder: where the job and all that it makes lie.
        files: the images' names in the folder's ``IMAGE_FOLDER``, without spaces.
        cameras: for each image the number of its camera, from 1.
        faint: whether features are few and weak, as in thermal images.
    """

    folder: Path
    files: tuple[str, ...]
    cameras: tuple[int, ...]
    faint: bool

    @property
    def root(self) -> Path:
        """Where the images lie."""
        return self.folder / IMAGE_FOLDER

    @property
    def database(self) -> Path:
        """Features and matches."""
        return self.folder / "database.db"


def read_job(folder: Path) -> Job:
    """The job in a folder; it was written by this program."""
    content = json.loads((folder / JOB_FILE).read_text(encoding="utf-8"))
    images = content["images"]
    return Job(
        folder,
        tuple(image["file"] for image in images),
        tuple(image["camera"] for image in images),
        content["stretch"],
    )


def threads() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
