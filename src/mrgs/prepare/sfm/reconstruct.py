"""Poses from the images alone (structure from motion)."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import msgspec
import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8
from PIL import Image
from scipy.ndimage import gaussian_filter

from mrgs.data.colmap import ColmapModel, read_images
from mrgs.data.earth import enu
from mrgs.data.images import decode
from mrgs.data.kept import digest
from mrgs.data.radiometric import GpsPosition
from mrgs.errors import ConfigError, SceneError
from mrgs.prepare.contract import MIN_VIEWS, Progress, Reconstruction, Skipped, TooFewPosesError
from mrgs.prepare.control import Fixed
from mrgs.prepare.sfm.job import (
    ADJUSTED_FOLDER,
    CONTROL_FILE,
    IMAGE_FOLDER,
    JOB_FILE,
    MODEL_FOLDER,
    POINTS_FILE,
    REPORT_FILE,
    SFM_FOLDER,
    ImageReport,
    JobFile,
    JobImage,
    ModelReport,
    read_job_file,
)
from mrgs.scene import THERMAL, Modality, PointCloud
from mrgs.scene.camera import focal_length
from mrgs.scene.similarity import Similarity
from mrgs.system.atomic import remove, replacing, write_error, write_text
from mrgs.system.child import OUT_OF_MEMORY, Child
from mrgs.system.disk import read_text
from mrgs.system.wording import listed


def reconstruct(
    images: Mapping[str, Path],
    work: Path,
    progress: Progress,
    *,
    modality: Modality,
    gps: Mapping[str, GpsPosition] | None = None,
    field_of_view_deg: float | None = None,
) -> Reconstruction:
    """Poses and points from overlapping images of one camera, by incremental structure from motion
    (Schönberger and Frahm, 2016; pycolmap).

    GPS decides which images are matched where there are many, or where the poses from all matches
    contradict it; the poses themselves come from the images alone.

    Results are kept in ``work/sfm``, in COLMAP's formats, for the next call with the same images.

    Args:
        images: files by the views' names, in the order in which they were taken; all of one size.
        modality: of the images; the contrast of thermal ones is made even first.
        gps: positions by view; used where all images have one.
        field_of_view_deg: horizontal, of the camera, and then not refined: images of a flat façade
            hardly determine it. None for what the images' EXIF data say, refined.

    Raises:
        SceneError: fewer than three images get a pose, or an image cannot be read.
        ConfigError: pycolmap is not installed, or too old.
        RunError: the folder cannot be written.
    """
    if len(images) < MIN_VIEWS:
        raise SceneError(
            f"poses need {MIN_VIEWS} photos at least, and {len(images)} can be used; take more, "
            f"all around"
        )
    folder = work / SFM_FOLDER
    positions, focal_widths = positions_of(images, gps or {}), None
    if field_of_view_deg is not None:
        focal_widths = focal_length(1.0, math.radians(field_of_view_deg))
    set_up(folder, images, modality == THERMAL, progress, positions, focal_widths)
    require_pycolmap()
    remove(folder / CONTROL_FILE)  # of a call that was killed
    run_colmap(folder, progress)
    return read_result(folder, modality)


def positions_of(
    images: Mapping[str, Path], gps: Mapping[str, GpsPosition]
) -> Float64[np.ndarray, "n 3"] | None:
    """Metres east, north and up of the first image; None unless all have GPS, and up is 0 unless
    all have heights.
    """
    if any(name not in gps for name in images):
        return None
    places = [gps[name] for name in images]
    if any(place.altitude_m is None for place in places):
        places = [replace(place, altitude_m=None) for place in places]
    positions = enu(places, places[0])
    if places[0].altitude_m is None:
        positions[:, 2] = 0  # not the curvature of the Earth either
    return positions


CHILD = ("-m", "mrgs.prepare.sfm")
LOG_FILE = "log.txt"


def run_colmap(folder: Path, progress: Progress, program: Sequence[str] = CHILD) -> None:
    """Complete the job in ``folder``, where a log is written; see ``mrgs.prepare.sfm``. ``program``
    are the arguments of the Python interpreter that start the process. SceneError if that failed,
    crashed, or was killed; RunError if the folder cannot be written."""
    log = folder / LOG_FILE
    try:
        child = Child(program, str(folder.resolve()), log)
    except OSError as error:
        raise write_error(log, error) from None
    try:
        for message in child.messages():
            progress(message["step"], message["done"], message["of"])
    finally:
        child.close()
    if reason := child.failure():
        remedy = "; call again to continue"
        if child.end:  # the message is complete
            remedy = ""
        elif reason == OUT_OF_MEMORY:
            remedy = "; close other programs or use smaller photos, and call again to continue"
        raise SceneError(f"finding the poses failed: {reason}{remedy}; see {log}")


def require_pycolmap() -> None:
    """ConfigError if pycolmap is not installed. Only the child process imports it."""
    if find_spec("pycolmap") is None:
        raise ConfigError(
            'finding the poses needs pycolmap: pip install "mrgs[sfm]", or give poses that you have'
        )


FEW_FEATURES = 100
FEW_MATCHES = 30
ROUGH_PX = 1.0
_NAMED = 6


def adjusted(
    folder: Path, images: Modality, progress: Progress, similarity: Similarity, points: Fixed
) -> Reconstruction:
    """The model of ``reconstruct`` in the world of a similarity, adjusted to places in it by
    their marks. SceneError and RunError as for ``run_colmap``."""
    files = {image.name: image.file for image in read_job_file(folder).images}
    matrix = np.column_stack([similarity.scale * similarity.rotation, similarity.translation])
    rows = [(at, [(files[view], *pixel) for view, pixel in marks.items()]) for at, marks in points]
    write_text(folder / CONTROL_FILE, msgspec.json.encode((matrix.tolist(), rows)).decode())
    try:
        run_colmap(folder, progress)
    finally:
        remove(folder / CONTROL_FILE)
    return read_result(folder, images, ADJUSTED_FOLDER)


def read_result(folder: Path, images: Modality, name: str = MODEL_FOLDER) -> Reconstruction:
    """The largest model in a folder in which ``mrgs.prepare.sfm`` completed its job, with the
    reason for each image that is not in it. TooFewPosesError if fewer than ``MIN_VIEWS`` images
    have a pose."""
    job = read_job_file(folder)
    names = {image.file: image.name for image in job.images}
    model = folder / name
    report = msgspec.json.decode(read_text(model / REPORT_FILE), type=ModelReport)
    failed = tuple(
        Skipped(name, _reason(image, report.groups, names))
        for name, image in zip(names.values(), report.images, strict=True)
        if image.group != 0
    )
    if len(names) - len(failed) < MIN_VIEWS:
        raise TooFewPosesError(_too_few(len(names), failed), failed)
    registered = read_images(ColmapModel(model, ".bin"))
    with np.load(model / POINTS_FILE) as arrays:
        positions, colors, seen = arrays["positions"], arrays["colors"], arrays["seen"]
    points = PointCloud(torch.from_numpy(positions).float(), torch.from_numpy(colors).float() / 255)
    rows = {file: seen[:, 0] == number for number, file in enumerate(names)}
    return Reconstruction(
        viewmats={names[image.name]: image.viewmat for image in registered},
        lenses={names[image.name]: image.lens for image in registered},
        points=points,
        visible={
            names[image.name]: torch.from_numpy(seen[rows[image.name], 1]) for image in registered
        },
        failed=failed,
        reprojection_px=report.reprojection_px,
        source=f"Structure from motion with COLMAP: {len(registered)} of {len(names)} photos, "
        f"{len(positions)} points."
        f"{' Only photos taken near each other, by GPS, are matched.' if report.nearby else ''}",
        images=images,
        warnings=_warnings(report.groups, report.reprojection_px or 0.0),
    )


def _reason(image: ImageReport, groups: Sequence[int], names: Mapping[str, str]) -> str:
    """Why an image has no pose."""
    if image.features is None:
        return "the image could not be read"
    if image.features < FEW_FEATURES:
        return f"too little texture, or blurred ({image.features} features)"
    if image.group is not None:
        return f"connected only to a group of {groups[image.group]} photos, apart from the largest"
    other = "" if image.other is None else f", with {names[image.other]}"
    if image.matches < FEW_MATCHES:
        return f"little in common with any other photo ({image.matches} matches at most{other})"
    return f"no place among the others fits its matches ({image.matches} at most{other})"


def _too_few(count: int, failed: Sequence[Skipped]) -> str:
    """Which images failed and why, those with the same kind of reason together, in one line."""
    kinds: dict[str, list[str]] = {}
    for image in failed:
        kinds.setdefault(image.reason.partition(" (")[0], []).append(image.name)
    some = [f"{listed(names, _NAMED)}: {reason}" for reason, names in kinds.items()]
    return (
        f"only {count - len(failed)} of {count} photos could be placed, and {MIN_VIEWS} are needed "
        f"({'; '.join(some)}); take photos that overlap by two thirds, sharp and with texture"
    )


def _warnings(groups: Sequence[int], reprojection_px: float) -> tuple[str, ...]:
    found: tuple[str, ...] = ()
    if len(groups) > 1:
        sizes = ", ".join(str(size) for size in groups)
        found += (
            f"The photos fall into {len(groups)} groups that are not connected ({sizes} photos); "
            f"the largest is used. Photos that overlap both would join them.",
        )
    if reprojection_px > ROUGH_PX:
        found += (
            f"The poses are rough: points lie {reprojection_px:.1f} px from where they were seen "
            f"(mean). Sharper photos with more texture would help.",
        )
    return found


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
    """Deviations from the surroundings' mean over their root mean square, in [0, 1], 0.5 if none.
    The median root mean square is added to it, so that noise of flat surfaces stays small."""
    clipped = np.clip(values, *np.percentile(values, EXTREMES_PERCENT)).astype(np.float64)
    smooth = gaussian_filter(clipped - np.median(clipped), NOISE_SIGMA_PX)
    detail = smooth - gaussian_filter(smooth, DETAIL_SIGMA_PX)
    contrast = np.sqrt(gaussian_filter(detail**2, CONTRAST_SIGMA_PX))
    scale = RANGE * (contrast + np.median(contrast))
    shares = np.divide(detail, scale, out=np.zeros_like(detail), where=scale > 0)
    return np.clip(0.5 + 0.5 * shares, 0, 1).astype(np.float32)
