"""What a pane is painted from: colours, temperatures and depths on one pixel grid, from the model
or from a photo."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from mrgs.pictures.files import to_array, to_rgb8
from mrgs.render import Model, render
from mrgs.scene import RGB, THERMAL, Camera, PosedImage, Rendering, TemperatureRange
from mrgs.viewer.settings import Subject

SOLID_ALPHA = 0.5
"""Pixels that neither blend of the model covers as much are counted as empty: they have no
temperature and no depth."""


@dataclass(frozen=True, eq=False)
class Fields:
    """Images of one pane; None for what it does not need.

    Attributes:
        rgb: [h, w, 3].
        values: °C (normalised without °C), or their difference to the photo, [h, w]; NaN where the
            photo is masked.
        depth: z-depth in scene units, blended and divided by alpha, [h, w]; NaN where the model is
            empty.
        solid: where the model, or the photo, shows something, [h, w].
    """

    rgb: UInt8[np.ndarray, "h w 3"] | None
    values: Float[np.ndarray, "h w"] | None
    depth: Float[np.ndarray, "h w"] | None
    solid: Bool[np.ndarray, "h w"]


def render_pane(
    model: Model, camera: Camera, subject: Subject, as_photo_of: Camera | None = None
) -> Fields:
    """Render the modalities that the model has.

    Args:
        model: to render.
        camera: of the pane, at the size to render.
        subject: says what the model has.
        as_photo_of: the first camera of a captured view, to show what its cameras would have
            written; None to show what is there.
    """
    with torch.no_grad():
        rendering, _ = render(model, subject.cameras(camera))
    depth = to_array(surface_depth(rendering))
    if as_photo_of is not None:
        rendering = subject.camera_response(rendering, as_photo_of)
    return Fields(
        rgb=to_rgb8(rendering[RGB].image) if RGB in rendering else None,
        values=thermal_array(rendering[THERMAL].image, subject.temperature)
        if THERMAL in rendering
        else None,
        depth=depth,
        solid=np.isfinite(depth),
    )


def surface_depth(rendering: Rendering) -> Float[Tensor, "h w"]:
    """z-depth of what is seen, blended and divided by alpha; NaN where no blend covers a pixel by
    half.

    The thermal blend's where it covers the pixel, else the colour blend's: over a black background
    the coldest things may well be transparent in the thermal blend.
    """
    depths = [
        rendering[modality].surface_depth(SOLID_ALPHA)
        for modality in (THERMAL, RGB)
        if modality in rendering
    ]
    return reduce(lambda first, second: torch.where(first.isnan(), second, first), depths)


def photo_fields(photo: PosedImage, temperature: TemperatureRange | None) -> Fields:
    """The photo itself, at its own size.

    Raises:
        SceneError: it cannot be read.
    """
    pixels = photo.load()
    height, width = pixels.values.shape[:2]
    solid = np.ones((height, width), dtype=bool) if pixels.valid is None else pixels.valid.numpy()
    if pixels.values.shape[2] == 3:
        return Fields(to_rgb8(pixels.values), None, None, solid)
    values = np.where(solid, thermal_array(pixels.values, temperature), np.nan).astype(np.float32)
    return Fields(None, values, None, solid)


def difference(rendered: Fields, photo: Fields) -> Fields:
    """Rendered minus measured temperature; NaN where the photo is masked or the model empty."""
    assert rendered.values is not None
    assert photo.values is not None
    solid = rendered.solid & photo.solid
    values = np.where(solid, rendered.values - photo.values, np.nan).astype(np.float32)
    return Fields(None, values, rendered.depth, solid)


def thermal_array(
    thermal: Float[Tensor, "h w 1"], temperature: TemperatureRange | None
) -> Float[np.ndarray, "h w"]:
    """Normalised values as °C, or as they are without °C."""
    return to_array(
        thermal[..., 0] if temperature is None else temperature.to_celsius(thermal[..., 0])
    )
