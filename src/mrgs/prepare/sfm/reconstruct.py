"""Poses from the images alone (structure from motion)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from mrgs.data.earth import enu
from mrgs.data.radiometric import GpsPosition
from mrgs.errors import SceneError
from mrgs.prepare.contract import MIN_VIEWS, Progress, Reconstruction
from mrgs.prepare.sfm.job import set_up
from mrgs.prepare.sfm.process import check_version, installed_version, run_colmap
from mrgs.prepare.sfm.result import read_result
from mrgs.scene import THERMAL, Modality


def reconstruct(
    images: Mapping[str, Path],
    work: Path,
    progress: Progress,
    *,
    modality: Modality,
    gps: Mapping[str, GpsPosition] | None = None,
) -> Reconstruction:
    """Poses and points from overlapping images of one camera, by incremental structure from motion
    (Schönberger and Frahm, 2016; pycolmap).

    GPS decides which images are matched where there are many, or where the poses from all matches
    contradict it; the poses themselves come from the images alone.

    Results are kept in ``work/sfm``, in COLMAP's formats, for the next call with the same images.

    Args:
        images: files by the views' names, in the order in which they were taken; all of one size.
        work: folder for intermediate results.
        progress: called with the steps "contrast" (of thermal images), "features", "matching" and
            "mapping".
        modality: of the images; the contrast of thermal ones is stretched first.
        gps: positions by view; used where all images have one.

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
    set_up(folder, images, modality == THERMAL, progress, positions_of(images, gps or {}))
    check_version(installed_version())
    run_colmap(folder, progress)
    return read_result(folder, modality)


def positions_of(
    images: Mapping[str, Path], gps: Mapping[str, GpsPosition]
) -> Float64[np.ndarray, "n 3"] | None:
    """Metres east, north and up of the first image; None unless all have GPS, and up is 0 unless
    all have heights.

    Args:
        images: as for ``reconstruct``.
        gps: positions by view.
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
