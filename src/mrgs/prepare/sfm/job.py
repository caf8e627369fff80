"""The working folder of ``mrgs.prepare.colmap``: its images, and the job file that lists them."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from PIL import Image

from mrgs.prepare.cache import digest
from mrgs.prepare.colmap.job import IMAGE_FOLDER, JOB_FILE
from mrgs.prepare.contract import Progress
from mrgs.prepare.sfm.stretch import span_of, stretched
from mrgs.system.atomic import replacing, write_error

FORMAT = 3
"""Raise it when features or matches are found in another way: older ones are then discarded."""


def set_up(
    folder: Path,
    images: Mapping[str, Path],
    stretch: bool,
    progress: Progress,
    positions: Float64[np.ndarray, "n 3"] | None = None,
) -> None:
    """Set up the folder; features and matches of an earlier call stay if images and positions are
    the same.

    The images are named by numbers, so that no name can be misread.

    Args:
        folder: to work in.
        images: files by the views' names.
        stretch: whether to stretch the contrast, as thermal images need.
        progress: called for each image that is stretched.
        positions: where the images were taken, metres east, north and up.

    Raises:
        SceneError: an image cannot be read.
        RunError: the folder cannot be written.
    """
    content = json.dumps(_job(images, stretch, positions), indent=1).encode()
    file = folder / JOB_FILE
    try:
        if file.is_file() and file.read_bytes() == content:
            return
        shutil.rmtree(folder, ignore_errors=True)
        (folder / IMAGE_FOLDER).mkdir(parents=True)
        span = span_of(images.values()) if stretch else None
        for number, (name, source) in enumerate(
            zip(_files(images, stretch), images.values(), strict=True), 1
        ):
            target = folder / IMAGE_FOLDER / name
            if span is None:
                _link(source, target)
            else:
                Image.fromarray(stretched(source, span)).save(target)
                progress("contrast", number, len(images))
        with replacing(file) as temporary:  # last: it says that the rest is there
            temporary.write_bytes(content)
    except OSError as error:
        raise write_error(folder, error) from None


def _job(
    images: Mapping[str, Path], stretch: bool, positions: Float64[np.ndarray, "n 3"] | None
) -> dict[str, object]:
    """The content of the job file, which is equal for equal jobs."""
    listed = [
        {"file": file, "name": name, "sha256": digest(source)}
        for file, (name, source) in zip(_files(images, stretch), images.items(), strict=True)
    ]
    rounded = None if positions is None else positions.round(3).tolist()
    return {"format": FORMAT, "stretch": stretch, "positions": rounded, "images": listed}


def _files(images: Mapping[str, Path], stretch: bool) -> list[str]:
    """The images' names in the folder."""
    suffixes = [".png" if stretch else source.suffix.lower() for source in images.values()]
    return [f"{number:06d}{suffix}" for number, suffix in enumerate(suffixes, 1)]


def _link(source: Path, target: Path) -> None:
    """A hard link, or a copy where the file system has no links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
