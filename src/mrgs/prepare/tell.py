"""What each stage's result says to the user."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mrgs.prepare.contract import Development, Georeference, Pairing, Reconstruction
from mrgs.prepare.rig import RigCalibration
from mrgs.prepare.stages import Told

SCALE_TOLERANCE = 0.03
"""Two sources of the scene's scale may differ by this share."""


def tell_pairs(pairing: Pairing) -> Told:
    """How many pairs there are, and how they were found."""
    lines = [f"{_count(len(pairing.pairs), 'pair')}. {pairing.rule}"]
    if pairing.left_out:
        lines.append(f"{_count(len(pairing.left_out), 'file')} left out.")
    return Told(tuple(lines), pairing.warnings)


def tell_photos(development: Development) -> Told:
    """What the photos hold; the warnings of single photos once each, with how many photos they are
    about."""
    views = development.views
    ranges = [view.range_c for view in views if view.range_c is not None]
    cameras = sorted({view.camera for view in views if view.camera is not None})
    facts = [_count(len(views), "view"), *cameras[:3]]
    if ranges:
        facts.append(
            f"{min(low for low, _ in ranges):.1f} °C to {max(high for _, high in ranges):.1f} °C"
        )
    if len(ranges) < len(views):
        facts.append(
            "no temperatures" if not ranges else f"{len(views) - len(ranges)} without temperatures"
        )
    lines = [", ".join(facts) + "."]
    if development.left_out:
        lines.append(f"{_count(len(development.left_out), 'pair')} left out.")
    by_text: dict[str, list[str]] = {}
    for view in views:
        for text in view.warnings:
            by_text.setdefault(text, []).append(view.name)
    return Told(
        tuple(lines),
        (*development.warnings, *(_about(text, names) for text, names in by_text.items())),
    )


def tell_poses(reconstruction: Reconstruction) -> Told:
    """Where the poses are from, and how well they fit."""
    lines = [reconstruction.source]
    if reconstruction.reprojection_px is not None:
        lines[0] += f" Reprojection error {reconstruction.reprojection_px:.2f} px."
    if reconstruction.failed:
        lines.append(f"{_count(len(reconstruction.failed), 'image')} without a pose.")
    return Told(tuple(lines), reconstruction.warnings)


def tell_place(georeference: Georeference) -> Told:
    """Scale and north."""
    return Told((georeference.text,), georeference.warnings)


def tell_thermal_camera(rig: RigCalibration | None, alone: bool, metric: bool) -> Told:
    """The lens, the offset and how well they fit, where there are two cameras."""
    if rig is None:
        return Told(
            ("There are thermal images alone." if alone else "One camera serves both images.",)
        )
    width_deg = math.degrees(2 * math.atan(0.5 * rig.lens.width / rig.lens.fx))
    baseline = float(rig.thermal_from_rgb[:3, 3].norm())
    scale = rig.target.metres_per_unit if rig.target is not None and not metric else None
    offset = (
        f"{100 * baseline * (scale or 1.0):.1f} cm"
        if metric or scale
        else f"{baseline:.3g} scene units"
    )
    lines = [
        f"{width_deg:.1f}° wide, {offset} from the RGB camera; "
        f"residual {rig.residual_px[0]:.2f} px, uncertainty ±{rig.uncertainty_px:.2f} px."
    ]
    if rig.target is not None:
        pairs, residual_px = _count(rig.target.pairs, "pair"), rig.target.residual_px[0]
        lines.append(f"The target is in {pairs}; residual {residual_px:.2f} px.")
    if scale:
        lines.append("The target gives the scale: the scene is in metres.")
    return Told(tuple(lines), (*rig.warnings, *_scales_that_differ(rig, metric)))


def _scales_that_differ(rig: RigCalibration, metric: bool) -> tuple[str, ...]:
    """Whether the target's squares contradict the metre that the scene has from elsewhere."""
    told = None if rig.target is None else rig.target.metres_per_unit
    if not metric or told is None or abs(told - 1) <= SCALE_TOLERANCE:
        return ()
    return (
        f"The target's squares say that the scene is {told:.2f} times as large as GPS or the "
        f"known distance says: "
        "check the side of a square, and the distance.",
    )


def _about(text: str, names: Sequence[str]) -> str:
    return f"{names[0]}: {text}" if len(names) == 1 else f"{_count(len(names), 'photo')}: {text}"


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
