"""Facts about the lenses, and about the thermal camera relative to the other camera."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from mrgs.data.lens import Lens
from mrgs.prepare.contract import Georeference
from mrgs.prepare.rig.contract import RigCalibration
from mrgs.scene.camera import field_of_view
from mrgs.system.wording import counted


class RigFacts(NamedTuple):
    """The calibrated thermal camera on the page.

    Attributes:
        rows: facts about the camera.
        views: name, matches, residual and uncertainty of each view, the least certain first.
    """

    rows: list[tuple[str, str]]
    views: list[tuple[str, str, str, str]]


def lens_rows(lenses: Mapping[str, Lens], what: str) -> list[tuple[str, str]]:
    """A row for each distinct lens, with the number of its views."""
    distinct: dict[Lens, int] = {}
    for lens in lenses.values():
        distinct[lens] = distinct.get(lens, 0) + 1
    return [
        (f"{what}, {counted(count, 'view')}", lens_text(lens)) for lens, count in distinct.items()
    ]


def lens_text(lens: Lens) -> str:
    """Size, field of view, focal length, principal point and distortion, in a sentence."""
    wide, high = (
        math.degrees(field_of_view(pixels, focal))
        for pixels, focal in ((lens.width, lens.fx), (lens.height, lens.fy))
    )
    text = (
        f"{lens.width} × {lens.height} px, {wide:.1f}° × {high:.1f}°, focal length {lens.fx:.1f} "
        f"× {lens.fy:.1f} px, "
        f"centre {lens.cx:.1f}, {lens.cy:.1f} px"
    )
    names = ("k1", "k2", "k3", "k4", "p1", "p2")
    bent = [
        f"{name} {value:.4g}"
        for name, value in zip(names, (*lens.radial, *lens.tangential), strict=True)
        if value
    ]
    model = "fisheye " if lens.fisheye else ""
    return (
        f"{text}, {model}distortion {', '.join(bent)}"
        if bent
        else f"{text}, {model or 'no '}distortion"
    )


def rig_facts(rig: RigCalibration, georeference: Georeference | None) -> RigFacts:
    """The calibrated thermal camera: facts, and a row for each view."""
    metric = georeference is not None and georeference.metric
    median, most = rig.residual_px
    rows = [
        ("Thermal lens", lens_text(rig.lens)),
        ("Distance between the lenses", _offset(rig.extrinsics, metric)),
        (
            "Angle between the axes",
            f"{math.degrees(torch.acos(rig.extrinsics[2, 2].clamp(-1, 1)).item()):.2f}°",
        ),
        (
            "Residual",
            f"{median:.2f} px (median), {most:.2f} px (90th percentile), in thermal pixels",
        ),
        ("Uncertainty", f"{rig.uncertainty_px:.2f} px (one standard deviation)"),
        ("Motion between pairs", f"{rig.motion_px:.2f} px (median)"),
    ]
    if rig.target is not None:
        fit = rig.target.residual_px[0]
        rows.append(
            (
                "Chessboard",
                f"seen by both cameras in {rig.target.pairs} pairs; median residual {fit:.2f} px",
            )
        )
    views = [
        (view.name, str(view.matches), _number(view.residual_px), _number(view.uncertainty_px))
        for view in sorted(
            rig.views,
            key=lambda view: (
                -(view.uncertainty_px if math.isfinite(view.uncertainty_px) else 1e9),
                view.name,
            ),
        )
    ]
    return RigFacts(rows, views)


def _offset(extrinsics: Float64[Tensor, "4 4"], metric: bool) -> str:
    """Distance and direction of the thermal camera from the photos' camera."""
    position = -extrinsics[:3, :3].T @ extrinsics[:3, 3]
    factor, unit, digits = (100.0, "cm", 1) if metric else (1.0, "scene units", 4)
    words = (("right", "left"), ("below", "above"), ("ahead", "behind"))
    parts = [
        f"{abs(value) * factor:.{digits}f} {plus if value >= 0 else minus}"
        for value, (plus, minus) in zip(position.tolist(), words, strict=True)
    ]
    return (
        f"{position.norm().item() * factor:.{digits}f} {unit}: the thermal camera is "
        f"{', '.join(parts)}"
    )


def _number(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "not known"
