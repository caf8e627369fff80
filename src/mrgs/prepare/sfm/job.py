"""The job: images to be reconstructed."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

Report = Callable[[str, int, int], None]
"""Called with a step's name, and how many of its parts are done and there are."""

JOB_FILE = "job.json"
IMAGE_FOLDER = "images"
MODEL_FOLDER = "model"
POINTS_FILE = "points.npz"
REPORT_FILE = "report.json"


@dataclass(frozen=True)
class ReconstructionJob:
    """Images of one camera, in the order in which they were taken.

    Attributes:
        folder: of the job and its results.
        files: the images' names in the folder's ``IMAGE_FOLDER``, without spaces.
        faint: whether features are few and weak, as in thermal images.
        positions: where they were taken, metres east, north and up; None where it is not known of
            all.
    """

    folder: Path
    files: tuple[str, ...]
    faint: bool
    positions: Float64[np.ndarray, "n 3"] | None = None

    @property
    def root(self) -> Path:
        """Folder of the images."""
        return self.folder / IMAGE_FOLDER

    @property
    def database(self) -> Path:
        """File of features and matches, COLMAP's database."""
        return self.folder / "database.db"


def read_job(folder: Path) -> ReconstructionJob:
    """The job that ``mrgs.prepare.sfm`` wrote into a folder."""
    content = json.loads((folder / JOB_FILE).read_text(encoding="utf-8"))
    files = tuple(image["file"] for image in content["images"])
    positions = content["positions"]
    return ReconstructionJob(
        folder, files, content["stretch"], None if positions is None else np.array(positions)
    )
