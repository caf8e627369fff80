"""The limits that a colour scale is locked at."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mrgs.pictures.files import shown_values
from mrgs.pictures.palette import display_range, tick_step
from mrgs.pictures.values import decimals_of, range_of
from mrgs.scene import Modality, Scene, TemperatureRange, evenly_spaced

PHOTOS_READ = 8
PIXEL_STEP = 4
"""Every so many rows and columns of a photo are enough for percentiles."""


def starting_limits(
    modalities: Sequence[Modality], scene: Scene | None, temperature: TemperatureRange | None
) -> dict[Modality, tuple[float, float]]:
    """Limits of every modality with a unit, in that unit: what some of the training photos show,
    but for half a percent at each end; the whole range without photos."""
    return {
        modality: _limits_of(modality, scene, temperature)
        for modality in modalities
        if modality.is_metric
    }


def rounded(
    modality: Modality, limits: tuple[float, float], temperature: TemperatureRange | None
) -> tuple[float, float]:
    """The limits, widened to round numbers; by a twentieth of the range or so, but not less than
    values of the modality are shown with."""
    finest = 10.0 ** -decimals_of(modality, temperature)
    step = max(tick_step(*limits, count=20), finest)
    low, high = math.floor(limits[0] / step + 1e-6), math.ceil(limits[1] / step - 1e-6)
    return round(low * step, 9), round(max(high, low + 1) * step, 9)


def _limits_of(
    modality: Modality, scene: Scene | None, temperature: TemperatureRange | None
) -> tuple[float, float]:
    views = [] if scene is None else [each for each in scene.train if modality in each.images]
    if not views:
        return range_of(modality, temperature)
    seen = []
    for index in evenly_spaced(len(views), PHOTOS_READ):
        pixels = views[index].images[modality].load()
        values = shown_values(modality, pixels.values, temperature)[::PIXEL_STEP, ::PIXEL_STEP]
        valid = True if pixels.valid is None else pixels.valid.numpy()[::PIXEL_STEP, ::PIXEL_STEP]
        seen.append(np.where(valid, values, np.nan).ravel())
    return rounded(modality, display_range(np.concatenate(seen)), temperature)
