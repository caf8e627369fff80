"""Files between ``prepare`` and the process that finds poses: the images, and a report on each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float64

from mrgs.system.disk import read_text

Report = Callable[[str, int, int], None]
"""Called with a step's name, and how many of its parts are done and there are."""

JOB_FILE = "job.json"
SFM_FOLDER = "sfm"
IMAGE_FOLDER = "images"
MODEL_FOLDER = "model"
POINTS_FILE = "points.npz"
REPORT_FILE = "report.json"
CONTROL_FILE, ADJUSTED_FOLDER = "control.json", "adjusted"
JobControl = tuple[
    list[list[float]], list[tuple[tuple[float, float, float], list[tuple[str, float, float]]]]
]
"""Content of ``CONTROL_FILE``: the similarity [3, 4] from the model's world to the control points';
the place of each, and the image's file, x and y of its marks."""

FORMAT = 5
"""Raise it when features or matches are found in another way: older ones are then discarded."""


class JobImage(msgspec.Struct, frozen=True):
    """An image's file in ``IMAGE_FOLDER``, the view's name, and the digest of the original."""

    file: str
    name: str
    sha256: str = ""


class JobFile(msgspec.Struct, frozen=True):
    """Content of ``JOB_FILE``; ``positions`` are metres east, north and up."""

    images: tuple[JobImage, ...]
    thermal: bool = False
    positions: tuple[tuple[float, float, float], ...] | None = None
    focal_widths: float | None = None
    format: int = FORMAT


class ImageReport(msgspec.Struct, frozen=True):
    """Number of features (None if the image cannot be read), most matches with another image, and
    which of the models the image is in."""

    features: int | None
    matches: int
    other: str | None = msgspec.field(name="with")
    group: int | None


class ModelReport(msgspec.Struct, frozen=True):
    """Content of ``REPORT_FILE``: the images in the job's order, the number of images of each
    model, largest first, and whether only images taken near each other are matched."""

    images: tuple[ImageReport, ...]
    groups: tuple[int, ...]
    reprojection_px: float | None
    nearby: bool


@dataclass(frozen=True)
class ReconstructionJob:
    """Images of one camera, in the order in which they were taken.

    Attributes:
        folder: of the job and its results.
        files: names of the images in ``root``.
        thermal: whether the images are thermal: their features are few and weak.
        positions: where they were taken, metres east, north and up; None if not known for all.
        focal_widths: focal length in widths of the image held level; None if nobody states it.
    """

    folder: Path
    files: tuple[str, ...]
    thermal: bool
    positions: Float64[np.ndarray, "n 3"] | None = None
    focal_widths: float | None = None

    @property
    def root(self) -> Path:
        """Folder of the images."""
        return self.folder / IMAGE_FOLDER

    @property
    def database(self) -> Path:
        """File of features and matches, COLMAP's database."""
        return self.folder / "database.db"


def read_job_file(folder: Path) -> JobFile:
    """The job file's content. OSError, UnicodeDecodeError or msgspec.DecodeError if unreadable."""
    return msgspec.json.decode(read_text(folder / JOB_FILE), type=JobFile)


def read_job(folder: Path) -> ReconstructionJob:
    """The job in a working folder."""
    job = read_job_file(folder)
    positions = None if job.positions is None else np.array(job.positions)
    files = tuple(image.file for image in job.images)
    return ReconstructionJob(folder, files, job.thermal, positions, job.focal_widths)
