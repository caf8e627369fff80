"""The folder in which ``mrgs.prepare.colmap`` works: its images, and what they were made of."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from PIL import Image

from mrgs.data.images import probe
from mrgs.errors import RunError, SceneError
from mrgs.prepare.cache import digest
from mrgs.prepare.colmap.job import IMAGE_FOLDER, JOB_FILE
from mrgs.prepare.contract import Progress
from mrgs.prepare.sfm.stretch import span_of, stretched
from mrgs.system.atomic import replacing

FORMAT = 1
"""To be raised when features or matches are found in another way: older ones are then not
continued."""


def set_up(
    folder: Path,
    images: Mapping[str, Path],
    cameras: Mapping[str, str],
    stretch: bool,
    progress: Progress,
) -> None:
    """Make the folder ready; what an earlier call left there stays if it was made of the same
    images.

    The images get numbers for names, so that nothing in a name can be misread.

    Raises:
        SceneError: images of one camera differ in size, or cannot be read.
        RunError: the folder cannot be written.
    """
    _check_sizes(images, cameras)
    content = json.dumps(_job(images, cameras, stretch), indent=1).encode()
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
        raise RunError(
            f"{folder} cannot be written ({error.strerror}); free the place or choose another"
        ) from None


def _job(
    images: Mapping[str, Path], cameras: Mapping[str, str], stretch: bool
) -> dict[str, object]:
    """The content of the job's file: what ``mrgs.prepare.colmap`` reads, and what tells whether it
    is the same job."""
    numbers = {
        camera: number
        for number, camera in enumerate(sorted({cameras[name] for name in images}), 1)
    }
    listed = [
        {"file": file, "camera": numbers[cameras[name]], "name": name, "sha256": digest(source)}
        for file, (name, source) in zip(_files(images, stretch), images.items(), strict=True)
    ]
    return {"format": FORMAT, "stretch": stretch, "images": listed}


def _files(images: Mapping[str, Path], stretch: bool) -> list[str]:
    """The images' names in the folder."""
    suffixes = [".png" if stretch else source.suffix.lower() for source in images.values()]
    return [f"{number:06d}{suffix}" for number, suffix in enumerate(suffixes, 1)]


def _check_sizes(images: Mapping[str, Path], cameras: Mapping[str, str]) -> None:
    first: dict[str, tuple[Path, tuple[int, int]]] = {}
    for name, path in images.items():
        info = probe(path)
        other, size = first.setdefault(cameras[name], (path, (info.width, info.height)))
        if (info.width, info.height) != size:
            raise SceneError(
                f"{path} is {info.width}×{info.height} px, but {other.name} of the same camera is "
                f"{size[0]}×{size[1]} px; prepare photos of different cameras, crops or zooms as "
                f"different scenes"
            )


def _link(source: Path, target: Path) -> None:
    """The same file under another name, or a copy where the file system knows no such thing."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
