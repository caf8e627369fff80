"""Data of the pages with a 3D view: cameras, the world, colour scales and their limits."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from mrgs.errors import SceneError
from mrgs.pictures.files import shown_values
from mrgs.pictures.palette import PALETTES, PaletteName, display_range, palette_table, tick_step
from mrgs.pictures.values import capitalised, decimals_of, range_of, unit_label
from mrgs.scene import Camera, Modality, Scene, TemperatureRange, evenly_spaced
from mrgs.scene.camera import focus_point
from mrgs.survey import Survey

STAGE_STYLE = "pictures/web/stage.css"
"""Style sheet of the pages with a 3D view."""

MARKS_STYLE = "pictures/web/marks.css"
"""Style sheet of the marks on them."""

BASE64_SCRIPT = "pictures/web/base64.js"
"""Script for bytes in a page, which the exported page's worker runs too."""

GEOMETRY_SCRIPT = "pictures/web/geometry.js"
"""Script for vectors and what cameras see, which ``navigation.js`` and that worker need."""

STAGE_SCRIPTS = (
    BASE64_SCRIPT,
    GEOMETRY_SCRIPT,
    "pictures/web/facts.js",
    "pictures/web/navigation.js",
    "pictures/web/numbers.js",
    "pictures/web/scale.js",
    "pictures/web/range.js",
    "pictures/web/isotherm.js",
    "pictures/web/marks.js",
)
"""Scripts of all pages with a 3D view: facts, navigation, colour scale, isotherm, marks."""

PALETTE_CHOICES: tuple[PaletteName, ...] = tuple(
    name for name in PALETTES if name not in ("depth", "error")
)
"""Palettes that the reader of such a page may choose."""

PHOTOS_READ = 8
PIXEL_STEP = 4
"""Step between the rows and columns of a photo that are read for percentiles."""


def camera_facts(camera: Camera) -> dict[str, Any]:
    """A camera for ``navigation.js``; the rotation's rows are its axes right, down, forward."""
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


def starting_limits(
    modalities: Sequence[Modality], scene: Scene | None, temperature: TemperatureRange | None
) -> dict[Modality, tuple[float, float]]:
    """Limits of every modality with a unit, in that unit: what some of the training photos show,
    but for half a percent at each end; the whole range without photos."""
    found = {}
    for modality in (each for each in modalities if each.is_metric):
        photos = [] if scene is None else scene.train_photos(modality)
        seen = []
        for index in evenly_spaced(len(photos), PHOTOS_READ):
            try:
                pixels = photos[index].load()
            except SceneError:  # a damaged photo has no part in the range
                continue
            values = shown_values(modality, pixels.values, temperature)
            valid = True if pixels.valid is None else pixels.valid.numpy()
            seen.append(np.where(valid, values, np.nan)[::PIXEL_STEP, ::PIXEL_STEP].ravel())
        found[modality] = range_of(modality, temperature)
        if seen:
            found[modality] = rounded(modality, display_range(np.concatenate(seen)), temperature)
    return found


def rounded(
    modality: Modality, limits: tuple[float, float], temperature: TemperatureRange | None
) -> tuple[float, float]:
    """The limits, widened to round numbers; by a twentieth of the range or so, but not less than
    values of the modality are shown with."""
    finest = 10.0 ** -decimals_of(modality, temperature)
    step = max(tick_step(*limits, count=20), finest)
    low, high = math.floor(limits[0] / step + 1e-6), math.ceil(limits[1] / step - 1e-6)
    return round(low * step, 9), round(max(high, low + 1) * step, 9)
