"""What the scripts of the pages with a 3D view read: cameras, the world, and colour scales."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from mrgs.pictures.palette import PaletteName, palette_table
from mrgs.pictures.values import capitalised, decimals_of, range_of, unit_label
from mrgs.scene import Camera, Modality, TemperatureRange
from mrgs.scene.camera_paths import focus_point
from mrgs.survey import Survey

STAGE_STYLE = "pictures/web/stage.css"
"""Style sheet of the pages with a 3D view."""

MARKS_STYLE = "pictures/web/marks.css"
"""Style sheet of the marks on them."""

BASE64_SCRIPT = "pictures/web/base64.js"
"""Script for bytes in a page, which the exported page's worker runs too."""

STAGE_SCRIPTS = (
    BASE64_SCRIPT,
    "pictures/web/facts.js",
    "pictures/web/navigation.js",
    "pictures/web/numbers.js",
    "pictures/web/scale.js",
    "pictures/web/range.js",
    "pictures/web/isotherm.js",
    "pictures/web/marks.js",
)
"""Scripts of the same: what they read of their facts, where the camera is, the scale beside it, and
the marks."""

PALETTE_CHOICES: tuple[PaletteName, ...] = (
    "inferno",
    "iron",
    "grey",
    "black-hot",
    "rainbow",
    "arctic",
    "lava",
)
"""Palettes that the reader of such a page may choose."""


def camera_facts(camera: Camera) -> dict[str, Any]:
    """A camera for ``navigation.js``: the rows of the rotation are its axes right, down and
    forward in the world."""
    return {
        "rotation": camera.viewmat[:3, :3].flatten().tolist(),
        "position": camera.position.tolist(),
        "fx": camera.K[0, 0].item(),
        "fy": camera.K[1, 1].item(),
        "cx": camera.K[0, 2].item(),
        "cy": camera.K[1, 2].item(),
        "width": camera.width,
        "height": camera.height,
    }


def world_facts(cameras: Sequence[Camera]) -> dict[str, list[float]]:
    """Where the cameras look, and which way is up: against their mean down axis."""
    up = -torch.stack([camera.viewmat[1, :3] for camera in cameras]).mean(dim=0)
    if up.norm() < 1e-6:
        up = -cameras[0].viewmat[1, :3]
    return {"focus": focus_point(cameras).tolist(), "up": (up / up.norm()).tolist()}


def palette_facts(names: Sequence[PaletteName]) -> dict[str, str]:
    """The 256 colours of palettes, as base64 of their bytes."""
    return {name: base64.b64encode(palette_table(name).tobytes()).decode() for name in names}


def modality_facts(
    modality: Modality, temperature: TemperatureRange | None, limits: Sequence[float]
) -> Mapping[str, Any]:
    """A modality for ``scale.js``: name and label, what its normalised values 0 and 1 stand for,
    and the limits that its colour scale starts with."""
    low, high = range_of(modality, temperature)
    return {
        "name": modality.name,
        "label": capitalised(modality.quantity),
        "channels": modality.channels,
        "metric": modality.is_metric,
        "scale": {
            "min": low,
            "max": high,
            "unit": unit_label(modality, temperature),
            "decimals": decimals_of(modality, temperature),
        },
        "range": list(limits),
    }


def air_facts(survey: Survey) -> dict[str, float | None]:
    """What the air was like, for ``isotherm.js``; None for what the survey does not state."""
    return {name: getattr(survey, name) for name in ("inside_c", "outside_c", "humidity_percent")}
