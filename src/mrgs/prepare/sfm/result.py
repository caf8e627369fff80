"""The results of ``mrgs.prepare.colmap`` as a Reconstruction."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mrgs.data.colmap_model import ColmapModel, read_images
from mrgs.prepare.colmap.job import JOB_FILE, MODEL_FOLDER, POINTS_FILE, REPORT_FILE
from mrgs.prepare.contract import MIN_VIEWS, Reconstruction, Skipped, TooFewPosesError
from mrgs.scene import Modality, PointCloud
from mrgs.system.wording import listed

FEW_FEATURES = 100
FEW_MATCHES = 30
ROUGH_PX = 1.0
_NAMED = 6


def read_result(folder: Path, images: Modality) -> Reconstruction:
    """The largest model, with the reason for each image that is not in it.

    Args:
        folder: in which ``mrgs.prepare.colmap`` completed its job.
        images: modality of the images.

    Raises:
        TooFewPosesError: fewer than ``MIN_VIEWS`` images have a pose.
    """
    listed = _read(folder / JOB_FILE)["images"]
    names = {image["file"]: image["name"] for image in listed}
    model = folder / MODEL_FOLDER
    report = _read(model / REPORT_FILE)
    failed = _failed(names, report)
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
        reprojection_px=report["reprojection_px"],
        source=f"Structure from motion with COLMAP: {len(registered)} of {len(names)} photos, "
        f"{len(positions)} points."
        f"{' Only photos taken near each other, by GPS, are matched.' if report['nearby'] else ''}",
        images=images,
        warnings=_warnings(report["groups"], report["reprojection_px"]),
    )


def _read(file: Path) -> dict[str, Any]:
    return json.loads(file.read_text(encoding="utf-8"))


def _failed(names: Mapping[str, str], report: dict[str, Any]) -> tuple[Skipped, ...]:
    """The images outside of the largest model, in order."""
    pairs = zip(names.values(), report["images"], strict=True)
    return tuple(
        Skipped(name, _reason(image, report["groups"], names))
        for name, image in pairs
        if image["group"] != 0
    )


def _reason(image: dict[str, Any], groups: Sequence[int], names: Mapping[str, str]) -> str:
    """Why an image has no pose."""
    features, matches = image["features"], image["matches"]
    if features is None:
        return "the image could not be read"
    if features < FEW_FEATURES:
        return f"too little texture, or blurred ({features} features)"
    if image["group"] is not None:
        return (
            f"connected only to a group of {groups[image['group']]} photos, apart from the largest"
        )
    if matches < FEW_MATCHES:
        other = f", with {names[image['with']]}" if matches else ""
        return f"little in common with any other photo ({matches} matches at most{other})"
    return (
        f"no place among the others fits its matches ({matches} at most, with "
        f"{names[image['with']]})"
    )


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
            f"the largest is used. "
            "Photos that overlap both would join them.",
        )
    if reprojection_px > ROUGH_PX:
        found += (
            f"The poses are rough: points lie {reprojection_px:.1f} px from where they were seen "
            f"(mean). "
            "Sharper photos with more texture would help.",
        )
    return found
