"""The working folder of ``mrgs.prepare.sfm``: its images, and the job file that lists them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float32, Float64, UInt8
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from mrgs.data.images import decode
from mrgs.data.kept import digest
from mrgs.errors import SceneError
from mrgs.prepare.contract import Progress
from mrgs.prepare.sfm.job import IMAGE_FOLDER, JOB_FILE, JobFile, JobImage
from mrgs.system.atomic import replacing, write_error


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
        stretch: whether to stretch the contrast, as thermal images need.
        positions: where the images were taken, metres east, north and up.

    Raises:
        SceneError: an image cannot be read.
        RunError: the folder cannot be written.
    """
    job, file = _job(images, stretch, positions), folder / JOB_FILE
    try:
        if file.is_file():
            with suppress(msgspec.DecodeError, UnicodeDecodeError):
                if msgspec.json.decode(file.read_bytes(), type=JobFile) == job:
                    return
        shutil.rmtree(folder, ignore_errors=True)
        (folder / IMAGE_FOLDER).mkdir(parents=True)
        span = span_of(images.values()) if stretch else None
        for number, (image, source) in enumerate(zip(job.images, images.values(), strict=True), 1):
            target = folder / IMAGE_FOLDER / image.file
            if span is None:
                _link(source, target)
            else:
                Image.fromarray(stretched(source, span)).save(target)
                progress("contrast", number, len(images))
        with replacing(file) as temporary:  # last: the rest is then complete
            temporary.write_bytes(msgspec.json.encode(job))
    except OSError as error:
        raise write_error(folder, error) from None


def _job(
    images: Mapping[str, Path], stretch: bool, positions: Float64[np.ndarray, "n 3"] | None
) -> JobFile:
    named = tuple(
        JobImage(
            f"{number:06d}{'.png' if stretch else source.suffix.lower()}", name, digest(source)
        )
        for number, (name, source) in enumerate(images.items(), 1)
    )
    rounded = None if positions is None else tuple(map(tuple, positions.round(3).tolist()))
    return JobFile(named, stretch, rounded)


def _link(source: Path, target: Path) -> None:
    """A hard link, or a copy where the file system has no links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


SPAN_PERCENTILES = (0.5, 99.5)
TILES = 8
"""Along the longer side."""

BINS = 1024
CLIP = 10.0
"""Limit of a histogram over its mean: a higher one amplifies the noise of flat surfaces."""

_NOISE_SIGMA_PX = 0.7
_SAMPLES = 4096


def span_of(files: Iterable[Path]) -> tuple[float, float]:
    """The values between which nearly all pixels of a set lie.

    Raises:
        SceneError: an image cannot be read, or all pixels are alike.
    """
    samples = []
    for file in files:
        decoded = decode(file)
        values = decoded.values.mean(dim=-1)
        values = values.ravel() if decoded.valid is None else values[decoded.valid]
        samples.append(values[:: max(len(values) // _SAMPLES, 1)].numpy())
    low, high = np.percentile(np.concatenate(samples), SPAN_PERCENTILES)
    if not high > low:
        raise SceneError(
            "the thermal images show the same value everywhere; check that they are the right files"
        )
    return float(low), float(high)


def stretched(file: Path, span: tuple[float, float]) -> UInt8[np.ndarray, "h w"]:
    """The image in grey, with stretched contrast.

    Raises:
        SceneError: it cannot be read.
    """
    decoded = decode(file)
    values = decoded.values.mean(dim=-1).numpy()
    if decoded.valid is not None:
        values[~decoded.valid.numpy()] = span[0]
    shares = np.clip((values - span[0]) / (span[1] - span[0]), 0, 1)
    return np.rint(255 * local_contrast(gaussian_filter(shares, _NOISE_SIGMA_PX))).astype(np.uint8)


def local_contrast(shares: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Contrast-limited adaptive histogram equalisation (Zuiderveld, 1994) of values from 0 to 1.

    Each pixel's value is replaced by its rank in the tiles around it, linear between their centres.
    """
    height, width = shares.shape
    side = max(height, width) / TILES
    rows, columns = max(round(height / side), 1), max(round(width / side), 1)
    bins = np.minimum((shares * BINS).astype(np.int64), BINS - 1)
    bands = (np.array_split(band, columns, axis=1) for band in np.array_split(bins, rows))
    ranks = np.stack([np.stack([_ranks(tile) for tile in band]) for band in bands])
    places = [
        (np.arange(count) + 0.5) * tiles / count - 0.5
        for count, tiles in ((height, rows), (width, columns))
    ]
    where = np.broadcast_arrays(places[0][:, None], places[1], bins)
    return map_coordinates(ranks, where, np.float64, order=1, mode="nearest").astype(np.float32)


def _ranks(tile: np.ndarray) -> Float32[np.ndarray, " bins"]:
    """For each value the share of the tile's pixels below it, with the histogram's peaks
    clipped and redistributed evenly."""
    histogram = np.bincount(tile.ravel(), minlength=BINS).astype(np.float64)
    limit = CLIP * tile.size / BINS
    excess = np.maximum(histogram - limit, 0).sum()
    return (np.cumsum(np.minimum(histogram, limit) + excess / BINS) / max(tile.size, 1)).astype(
        np.float32
    )
