"""From images to a reconstruction."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from mrgs.errors import SceneError
from mrgs.prepare.contract import MIN_VIEWS, Progress, Reconstruction
from mrgs.prepare.sfm.job import set_up
from mrgs.prepare.sfm.process import run_colmap
from mrgs.prepare.sfm.result import read_result
from mrgs.scene import THERMAL, Modality


def reconstruct(
    images: Mapping[str, Path],
    cameras: Mapping[str, str],
    work: Path,
    progress: Progress,
    *,
    modality: Modality,
) -> Reconstruction:
    """Poses and points from images that overlap (Schönberger and Frahm, 2016, by way of pycolmap).

    All that is found is kept in ``work/sfm``, in COLMAP's formats, for the next call with the same
    images.

    Args:
        images: files by the views' names, in the order in which they were taken.
        cameras: which camera took each view; all images of one share a lens and a size.
        work: folder for what is made on the way.
        progress: told of the steps "contrast" (of thermal images), "features", "matching" and
            "mapping".
        modality: of the images; the contrast of thermal ones is stretched first.

    Raises:
        SceneError: fewer than three images can be placed, or an image cannot be read.
        ConfigError: pycolmap is not installed.
        RunError: the folder cannot be written.
    """
    if len(images) < MIN_VIEWS:
        raise SceneError(
            f"poses need {MIN_VIEWS} photos at least, and {len(images)} can be used; take more, "
            f"all around"
        )
    folder = work / "sfm"
    set_up(folder, images, cameras, modality == THERMAL, progress)
    run_colmap(folder, progress)
    return read_result(folder, modality)
