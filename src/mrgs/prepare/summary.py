"""Summaries of the stages' results, for the terminal and the page."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mrgs.pictures.numbers import number_text
from mrgs.pictures.settings import settings_of, settings_text
from mrgs.prepare.contract import ConvertedPhotos, Pairing, Reconstruction, StageSummary
from mrgs.prepare.rig.contract import RigCalibration
from mrgs.scene import THERMAL, Modality
from mrgs.scene.camera import field_of_view
from mrgs.scene.radiometry import PhotoRecord
from mrgs.system.wording import counted

SCALE_TOLERANCE = 0.03
"""Two sources of the scene's scale may differ by this share."""


def summarize_pairs(pairing: Pairing) -> StageSummary:
    """Number of pairs, or of photos without partners, and the rule that found them."""
    has_pairs = any(pair.embedded or len(pair.photos) > 1 for pair in pairing.pairs)
    noun = "pair" if has_pairs or not pairing.pairs else "photo"
    lines = [f"{counted(len(pairing.pairs), noun)}. {pairing.rule}"]
    if pairing.skipped:
        lines.append(f"{counted(len(pairing.skipped), 'file')} skipped.")
    return StageSummary(tuple(lines), pairing.warnings)


def summarize_photos(photos: ConvertedPhotos) -> StageSummary:
    """Cameras and temperatures of the photos; each warning once, with the number of its photos."""
    views = photos.views
    ranges = [view.range_c for view in views if view.range_c is not None]
    cameras = sorted({view.facts.camera for view in views if view.facts.camera is not None})
    facts = [counted(len(views), "view"), *cameras[:3]]
    if ranges:
        low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
        facts.append(f"{number_text(low, 1)} °C to {number_text(high, 1)} °C")
    if len(ranges) < len(views):
        facts.append(
            "no temperatures" if not ranges else f"{len(views) - len(ranges)} without temperatures"
        )
    lines = [", ".join(facts) + "."]
    if ranges:
        lines.append(_settings_line([view.facts.record for view in views]))
    if photos.skipped:
        lines.append(f"{counted(len(photos.skipped), 'pair')} skipped.")
    by_text: dict[str, list[str]] = {}
    for view in views:
        for text in view.facts.warnings:
            by_text.setdefault(text, []).append(view.name)
    return StageSummary(
        tuple(lines),
        (*photos.warnings, *(_with_photos(text, names) for text, names in by_text.items())),
    )


def _settings_line(records: Sequence[PhotoRecord]) -> str:
    """What the temperatures were computed with."""
    known = settings_text(settings_of(records), "given by you")
    if known:
        return f"Temperatures computed with {known}."
    return (
        "The photos' files do not say with which emissivity, reflected temperature and distance "
        "the temperatures were computed."
    )


def summarize_poses(reconstruction: Reconstruction) -> StageSummary:
    """Source of the poses and their reprojection error."""
    lines = [reconstruction.source]
    if reconstruction.reprojection_px is not None:
        lines[0] += f" Reprojection error {reconstruction.reprojection_px:.2f} px."
    if reconstruction.failed:
        lines.append(f"{counted(len(reconstruction.failed), 'image')} without a pose.")
    return StageSummary(tuple(lines), reconstruction.warnings)


def summarize_thermal_camera(
    rig: RigCalibration | None, posed: Modality, metric: bool
) -> StageSummary:
    """Field of view, offset and residuals of the thermal camera.

    Args:
        rig: None if there is no second camera.
        posed: of the images with poses.
        metric: whether the unit of the scene's world is the metre.
    """
    if rig is None:
        alone = posed == THERMAL
        return StageSummary(
            ("There are only thermal images." if alone else "One camera took both images.",)
        )
    width_deg = math.degrees(field_of_view(rig.lens.width, rig.lens.fx))
    baseline = float(rig.extrinsics[:3, 3].norm())
    scale = rig.target.metres_per_unit if rig.target is not None and not metric else None
    offset = (
        f"{100 * baseline * (scale or 1.0):.1f} cm"
        if metric or scale
        else f"{baseline:.3g} scene units"
    )
    lines = [
        f"{width_deg:.1f}° wide, {offset} from the RGB camera; residual "
        f"{rig.residual_px[0]:.2f} px, uncertainty ±{rig.uncertainty_px:.2f} px."
    ]
    if turn_deg := _quarter_turn_deg(rig):
        lines.append(
            f"The thermal images are turned by about {turn_deg}° relative to the RGB images; the "
            f"offset includes this turn."
        )
    if rig.target is not None:
        pairs, residual_px = counted(rig.target.pairs, "pair"), rig.target.residual_px[0]
        lines.append(f"The target is in {pairs}; residual {residual_px:.2f} px.")
    if scale:
        lines.append("The target gives the scale: the scene is in metres.")
    return StageSummary(tuple(lines), (*rig.warnings, *_scales_that_differ(rig, metric)))


def _quarter_turn_deg(rig: RigCalibration) -> int:
    """By how many quarter turns the thermal images are turned: 0°, 90° or 180°."""
    sine, cosine = rig.extrinsics[1, 0].item(), rig.extrinsics[0, 0].item()
    return abs(90 * round(math.degrees(math.atan2(sine, cosine)) / 90))


def _scales_that_differ(rig: RigCalibration, metric: bool) -> tuple[str, ...]:
    """A warning if the target contradicts the scale from GPS or the known distance."""
    scale = None if rig.target is None else rig.target.metres_per_unit
    if not metric or scale is None or abs(scale - 1) <= SCALE_TOLERANCE:
        return ()
    return (
        f"The target's squares make the scene {scale:.2f} times as large as GPS or the known "
        f"distance: check the side of a square, and the distance.",
    )


def _with_photos(text: str, names: Sequence[str]) -> str:
    return f"{names[0]}: {text}" if len(names) == 1 else f"{counted(len(names), 'photo')}: {text}"
