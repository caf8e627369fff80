"""The working folder of ``mrgs.prepare.sfm``: its images, and the job file that lists them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float32, Float64, UInt8
from PIL import Image
from scipy.ndimage import gaussian_filter

from mrgs.data.images import decode
from mrgs.data.kept import digest
from mrgs.prepare.contract import Progress
from mrgs.prepare.sfm.job import IMAGE_FOLDER, JOB_FILE, JobFile, JobImage, read_job_file
from mrgs.system.atomic import replacing, write_error


def set_up(
    folder: Path,
    images: Mapping[str, Path],
    thermal: bool,
    progress: Progress,
    positions: Float64[np.ndarray, "n 3"] | None = None,
    focal_widths: float | None = None,
) -> None:
    """Set up the folder; features and matches of an earlier call stay if nothing has changed.
    Images are named by numbers; ``thermal`` ones get even local contrast. ``positions`` are metres
    east, north and up; ``focal_widths`` is in image widths. SceneError if an image cannot be read,
    RunError if the folder cannot be written."""
    named = tuple(
        JobImage(
            f"{number:06d}{'.png' if thermal else source.suffix.lower()}", name, digest(source)
        )
        for number, (name, source) in enumerate(images.items(), 1)
    )
    rounded = None if positions is None else tuple(map(tuple, positions.round(3).tolist()))
    job, file = JobFile(named, thermal, rounded, focal_widths), folder / JOB_FILE
    try:
        if file.is_file():
            with suppress(msgspec.DecodeError, UnicodeDecodeError):
                if read_job_file(folder) == job:
                    return
        shutil.rmtree(folder, ignore_errors=True)
        (folder / IMAGE_FOLDER).mkdir(parents=True)
        for number, (image, source) in enumerate(zip(job.images, images.values(), strict=True), 1):
            target = folder / IMAGE_FOLDER / image.file
            if thermal:
                Image.fromarray(evened(source)).save(target)
                progress("contrast", number, len(images))
            else:
                _link(source, target)
        with replacing(file) as temporary:  # last: the rest is then complete
            temporary.write_bytes(msgspec.json.encode(job))
    except OSError as error:
        raise write_error(folder, error) from None


def _link(source: Path, target: Path) -> None:
    """A hard link, or a copy where the file system has no links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


NOISE_SIGMA_PX = 1.0
"""Smooths the noise of the detector's pixels."""

DETAIL_SIGMA_PX = 16.0
"""What is smoother than this is removed: most of the shading, and all of an offset."""

CONTRAST_SIGMA_PX = 24.0
"""Around a pixel, where its local contrast is measured."""

EXTREMES_PERCENT = (1.0, 99.0)
"""Values beyond these, of lamps and the sky, are clipped: their surroundings would be flat."""

RANGE = 3.0
"""Range of the grey levels to either side, in multiples of the local contrast."""


def evened(file: Path) -> UInt8[np.ndarray, "h w"]:
    """The image in grey, with the same contrast everywhere: that of a thermal image varies, as well
    as its level, from place to place, and the level from photo to photo. SceneError if it cannot be
    read."""
    decoded = decode(file)
    values = decoded.values.mean(dim=-1).numpy()
    if decoded.valid is not None and not (valid := decoded.valid.numpy()).all():
        values[~valid] = np.median(values[valid]) if valid.any() else 0.0
    return np.rint(255 * local_contrast(values)).astype(np.uint8)


def local_contrast(values: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Deviations from the surroundings' mean over their root mean square, from 0 to 1; 0.5 is none.
    The median root mean square is added to it, so that noise of flat surfaces stays small."""
    clipped = np.clip(values, *np.percentile(values, EXTREMES_PERCENT)).astype(np.float64)
    smooth = gaussian_filter(clipped - np.median(clipped), NOISE_SIGMA_PX)
    detail = smooth - gaussian_filter(smooth, DETAIL_SIGMA_PX)
    contrast = np.sqrt(gaussian_filter(detail**2, CONTRAST_SIGMA_PX))
    scale = RANGE * (contrast + np.median(contrast))
    shares = np.divide(detail, scale, out=np.zeros_like(detail), where=scale > 0)
    return np.clip(0.5 + 0.5 * shares, 0, 1).astype(np.float32)
