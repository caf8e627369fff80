"""Values to colours: palettes, isotherm, blends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image

from mrgs.pictures.drawing import Scale, blank
from mrgs.pictures.palette import display_range
from mrgs.pictures.values import full_scale, unit_of
from mrgs.scene import Camera, Modality, SceneBounds, TemperatureRange
from mrgs.viewer.panes import Pane, PaneImages, PaneKind
from mrgs.viewer.settings import Settings, in_kelvin

Colors: TypeAlias = UInt8[np.ndarray, "h w 3"]

ISOTHERM_COLOR = (0, 230, 118)
ISOTHERM_ON_RAINBOW = (255, 0, 220)
"""The rainbow palette contains green."""

EMPTY_COLOR = (38, 41, 48)
"""Around the panes."""

NO_SURFACE_COLOR = (58, 66, 78)
"""Where there is no value: bluish, so that it is neither a cold place nor a grey one."""

Scales: TypeAlias = dict[Modality | PaneKind, Scale]
"""The scales of a picture's colours: of each one-channel modality that it shows; of ``depth`` from
far to near, of ``difference`` (model minus photo) even about zero, of ``uncertainty`` from zero."""

OWN_SCALE = ("depth", "difference", "uncertainty")
"""Kinds of panes whose scale is not that of their modality."""


@dataclass(frozen=True, eq=False)
class DrawnPicture:
    """A picture of a camera and what it was painted from; pixels without marks and scales, [H, W,
    3]."""

    camera: Camera
    panes: tuple[Pane, ...]
    images: tuple[PaneImages, ...]
    scales: Scales
    pixels: Colors

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.camera.width, self.camera.height


def scale_of(pane: Pane, scales: Scales) -> Scale | None:
    """The scale of a pane's colours; None for a pane of colours alone."""
    key = pane.kind if pane.kind in OWN_SCALE else pane.scaled
    return None if key is None else scales.get(key)


def measure_scales(
    panes: Sequence[Pane],
    images: Sequence[PaneImages],
    settings: Settings,
    temperature: TemperatureRange | None,
    ball: SceneBounds | None = None,
) -> Scales:
    """The scales that suit a picture: the limits that the user has set, else percentiles of what is
    seen; intensities always from 0 to 1. The background beyond the scene's ``ball`` does not count
    on the scale of the depth."""
    seen: dict[Modality | PaneKind, list[np.ndarray]] = {}
    for pane, shown in zip(panes, images, strict=True):
        key, modality = pane.kind if pane.kind in OWN_SCALE else pane.scaled, pane.scaled
        if pane.kind == "depth" and shown.depth is not None:
            values = _scene_depth(pane.camera, shown.depth, ball)
        elif modality is not None:
            values = shown.images[modality]
        else:
            continue
        assert key is not None
        seen.setdefault(key, []).append(values[shown.solid])
    for modality in settings.limits:
        seen.setdefault(modality, [])
    unit = in_kelvin(unit_of(panes[0].scaled, temperature)) if panes and panes[0].scaled else ""
    return {key: _scale(key, each, settings, temperature, unit) for key, each in seen.items()}


def _scale(
    key: Modality | PaneKind,
    seen: Sequence[Float[np.ndarray, " _"]],
    settings: Settings,
    temperature: TemperatureRange | None,
    unit: str,
) -> Scale:
    """The scale of some values; ``unit`` is that of differences and uncertainties."""
    if isinstance(key, Modality):
        scale = full_scale(key, temperature, settings.palette)
        if key in settings.limits:
            low, high = settings.limits[key]
        elif key.is_metric:
            low, high = display_range(np.concatenate(seen))
        else:
            return scale
        return scale._replace(low=low, high=high)
    values = np.concatenate(seen)
    if key == "depth":
        near, far = display_range(values)
        return Scale("depth", far, near, "")
    largest = display_range(np.abs(values))[1]
    if key == "difference":
        return Scale("error", -largest, largest, unit)
    return Scale(settings.palette, 0.0, largest, unit)


def _scene_depth(
    camera: Camera, depth: Float[np.ndarray, "h w"], ball: SceneBounds | None
) -> Float[np.ndarray, "h w"]:
    """The depth, infinite where it is the background's."""
    if ball is None:
        return depth
    height, width = depth.shape
    return ball.without_background(camera.resized(width, height), torch.from_numpy(depth)).numpy()


def paint(pane: Pane, images: PaneImages, scales: Scales, settings: Settings) -> Colors:
    """The colours of a pane at the size of its images, [H, W, 3]."""
    if pane.kind in OWN_SCALE:
        values = images.depth if pane.kind == "depth" else images.images[pane.modalities[0]]
        assert values is not None
        return _where_solid(scales[pane.kind].colorize(values), images)
    painted = [_paint_modality(each, images, scales, settings) for each in pane.modalities]
    if pane.kind in ("blend", "split"):
        below, above = painted
        return (blend if pane.kind == "blend" else split)(below, above, settings.share)
    return painted[0]


def _where_solid(painted: Colors, images: PaneImages) -> Colors:
    painted[~images.solid] = NO_SURFACE_COLOR
    return painted


def _paint_modality(
    modality: Modality, images: PaneImages, scales: Scales, settings: Settings
) -> Colors:
    """The colours of one modality: its own, or those of its scale and of the isotherm."""
    values = images.images[modality]
    if modality.channels > 1:
        return values
    painted = scales[modality].colorize(values)
    if modality == settings.scaled and settings.isotherm is not None:
        low, high = sorted(settings.isotherm)
        band = images.solid & (values >= low) & (values <= high)
        painted[band] = ISOTHERM_ON_RAINBOW if settings.palette == "rainbow" else ISOTHERM_COLOR
    # What the model does not cover has no temperature; the background's colour would look like a
    # cold one.
    return _where_solid(painted, images) if modality.is_metric else painted


def blend(below: Colors, above: Colors, share: float) -> Colors:
    """Mix two images [H, W, 3]: ``share`` 0 shows only the lower, 1 only the upper."""
    return np.rint((1 - share) * below + share * above.astype(np.float32)).astype(np.uint8)


def split(left: Colors, right: Colors, share: float) -> Colors:
    """Join two images [H, W, 3] at a vertical white line; the right one takes ``share`` of the
    width."""
    width = left.shape[1]
    column = round((1 - share) * width)
    image = np.concatenate([left[:, :column], right[:, column:]], axis=1)
    if 0 < column < width:
        image[:, column - 1 : column + 1] = 255
    return image


def compose(
    size: tuple[int, int],
    panes: Sequence[Pane],
    images: Sequence[PaneImages],
    scales: Scales,
    settings: Settings,
) -> Colors:
    """The picture alone, without marks and scales, [H, W, 3]; the images of each pane are stretched
    to it."""
    painted = [
        paint(pane, shown, scales, settings) for pane, shown in zip(panes, images, strict=True)
    ]
    if len(panes) == 1 and painted[0].shape[1::-1] == size:
        return painted[0]
    picture = blank(size, EMPTY_COLOR)
    for pane, colors in zip(panes, painted, strict=True):
        part = Image.fromarray(np.ascontiguousarray(colors))
        wanted = (pane.camera.width, pane.camera.height)
        if part.size != wanted:
            part = part.resize(wanted, Image.Resampling.BILINEAR)
        picture.paste(part, (pane.left, pane.top))
    return np.asarray(picture)
