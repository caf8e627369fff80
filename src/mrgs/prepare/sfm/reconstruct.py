"""Poses from the images alone (structure from motion)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from mrgs.errors import SceneError
from mrgs.prepare.contract import MIN_VIEWS, Progress, Reconstruction
from mrgs.prepare.sfm.job import set_up
from mrgs.prepare.sfm.process import check_version, installed_version, run_colmap
from mrgs.prepare.sfm.result import read_result
from mrgs.scene import THERMAL, Modality


def reconstruct(
    images: Mapping[str, Path], work: Path, progress: Progress, *, modality: Modality
) -> Reconstruction:
    """Poses and points from overlapping images of one camera, by incremental structure from motion
    (Schönberger and Frahm, 2016; pycolmap).

    Results are kept in ``work/sfm``, in COLMAP's formats, for the next call with the same images.

    Args:
        images: files by the views' names, in the order in which they were taken; all of one size.
        work: folder for intermediate results.
        progress: called with the steps "contrast" (of thermal images), "features", "matching" and
            "mapping".
        modality: of the images; the contrast of thermal ones is stretched first.

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
    folder = work / "sfm"
    set_up(folder, images, modality == THERMAL, progress)
    check_version(installed_version())
    run_colmap(folder, progress)
    return read_result(folder, modality)
