"""Values to colours: palettes, isotherm, blends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from mrgs.pictures.drawing import Scale, blank
from mrgs.pictures.palette import PaletteName, display_range
from mrgs.pictures.values import full_scale, unit_of
from mrgs.scene import Camera, Modality, SceneBounds, TemperatureRange
from mrgs.viewer.panes import Pane, PaneImages
from mrgs.viewer.settings import Settings, in_kelvin

ISOTHERM_COLOR = (0, 230, 118)
ISOTHERM_ON_RAINBOW = (255, 0, 220)
"""The rainbow palette contains green."""

EMPTY_COLOR = (38, 41, 48)
"""Around the panes."""

NO_SURFACE_COLOR = (58, 66, 78)
"""Where there is no value: bluish, so that it is neither a cold place nor a grey one."""


@dataclass(frozen=True)
class Scales:
    """The scales of a picture's colours; None or absent for what it does not show.

    Attributes:
        values: of each one-channel modality.
        depth: from far to near.
        difference: model minus photo, even about zero.
        uncertainty: from zero.
    """

    values: Mapping[Modality, Scale] = field(default_factory=dict)
    depth: Scale | None = None
    difference: Scale | None = None
    uncertainty: Scale | None = None

    def of(self, pane: Pane) -> Scale | None:
        """The scale of a pane's colours; None for a pane of colours alone."""
        if pane.kind == "difference":
            return self.difference
        if pane.kind == "uncertainty":
            return self.uncertainty
        if pane.kind == "depth":
            return self.depth
        return None if pane.scaled is None else self.values.get(pane.scaled)


def measure_scales(
    panes: Sequence[Pane],
    images: Sequence[PaneImages],
    settings: Settings,
    temperature: TemperatureRange | None,
    ball: SceneBounds | None = None,
) -> Scales:
    """The scales that suit a picture: the limits that the user has set, else percentiles of what is
    seen; intensities are always shown from 0 to 1.

    Args:
        ball: how far the scene reaches; the background beyond it does not count on the scale of the
            depth. None if there is none.
    """
    values: dict[Modality, list[np.ndarray]] = {}
    depth, errors, doubts = [], [], []
    unit = ""
    for pane, shown in zip(panes, images, strict=True):
        modality = pane.scaled
        if pane.kind == "depth" and shown.depth is not None:
            depth.append(_scene_depth(pane.camera, shown.depth, ball)[shown.solid])
        elif pane.kind == "difference" and modality is not None:
            errors.append(np.abs(shown.images[modality][shown.solid]))
            unit = in_kelvin(unit_of(modality, temperature))
        elif pane.kind == "uncertainty" and modality is not None:
            doubts.append(shown.images[modality][shown.solid])
            unit = in_kelvin(unit_of(modality, temperature))
        elif modality is not None:
            values.setdefault(modality, []).append(shown.images[modality][shown.solid])
    for modality in settings.limits:
        values.setdefault(modality, [])
    near_far = display_range(np.concatenate(depth)) if depth else None
    largest = display_range(np.concatenate(errors))[1] if errors else None
    widest = display_range(np.concatenate(doubts))[1] if doubts else None
    return Scales(
        {each: _scale_of(each, seen, settings, temperature) for each, seen in values.items()},
        None if near_far is None else Scale("depth", near_far[1], near_far[0], ""),
        None if largest is None else Scale("error", -largest, largest, unit),
        None if widest is None else Scale(settings.palette, 0.0, widest, unit),
    )


def _scale_of(
    modality: Modality,
    seen: Sequence[Float[np.ndarray, " _"]],
    settings: Settings,
    temperature: TemperatureRange | None,
) -> Scale:
    """The scale of a modality's values: the user's limits, or what suits the values that are
    seen."""
    scale = full_scale(modality, temperature, settings.palette)
    if modality in settings.limits:
        low, high = settings.limits[modality]
    elif modality.is_metric:
        low, high = display_range(np.concatenate(seen))
    else:
        return scale
    return scale._replace(low=low, high=high)


def _scene_depth(
    camera: Camera, depth: Float[np.ndarray, "h w"], ball: SceneBounds | None
) -> Float[np.ndarray, "h w"]:
    """The depth, infinite where it is the background's."""
    if ball is None:
        return depth
    height, width = depth.shape
    return ball.without_background(camera.resized(width, height), torch.from_numpy(depth)).numpy()


def paint(
    pane: Pane, images: PaneImages, scales: Scales, settings: Settings
) -> UInt8[np.ndarray, "h w 3"]:
    """The colours of a pane at the size of its images, [H, W, 3]."""
    if pane.kind == "depth":
        assert images.depth is not None
        assert scales.depth is not None
        return _where_solid(scales.depth.colorize(images.depth), images)
    if pane.kind in ("difference", "uncertainty"):
        (modality,) = pane.modalities
        scale = scales.of(pane)
        assert scale is not None
        return _where_solid(scale.colorize(images.images[modality]), images)
    painted = [_paint_modality(each, images, scales, settings) for each in pane.modalities]
    if pane.kind in ("blend", "split"):
        below, above = painted
        return (blend if pane.kind == "blend" else split)(below, above, settings.share)
    return painted[0]


def _where_solid(
    painted: UInt8[np.ndarray, "h w 3"], images: PaneImages
) -> UInt8[np.ndarray, "h w 3"]:
    painted[~images.solid] = NO_SURFACE_COLOR
    return painted


def _paint_modality(
    modality: Modality, images: PaneImages, scales: Scales, settings: Settings
) -> UInt8[np.ndarray, "h w 3"]:
    """The colours of one modality: its own, or those of its scale and of the isotherm."""
    values = images.images[modality]
    if modality.channels > 1:
        return values
    painted = scales.values[modality].colorize(values)
    if modality == settings.scaled and settings.isotherm is not None:
        band = images.solid & _in_band(values, settings.isotherm)
        painted[band] = isotherm_color(settings.palette)
    # What the model does not cover has no temperature; the background's colour would look like a
    # cold one.
    return _where_solid(painted, images) if modality.is_metric else painted


def isotherm_color(palette: PaletteName) -> tuple[int, int, int]:
    """Colour of the isotherm band, sRGB bytes: one that the palette does not contain."""
    return ISOTHERM_ON_RAINBOW if palette == "rainbow" else ISOTHERM_COLOR


def blend(
    below: UInt8[np.ndarray, "h w 3"], above: UInt8[np.ndarray, "h w 3"], share: float
) -> UInt8[np.ndarray, "h w 3"]:
    """Mix two images [H, W, 3]: ``share`` 0 shows only the lower, 1 only the upper."""
    return np.rint((1 - share) * below + share * above.astype(np.float32)).astype(np.uint8)


def split(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], share: float
) -> UInt8[np.ndarray, "h w 3"]:
    """Join two images [H, W, 3] at a vertical white line; the right one takes ``share`` of the
    width."""
    width = left.shape[1]
    column = round((1 - share) * width)
    image = np.concatenate([left[:, :column], right[:, column:]], axis=1)
    if 0 < column < width:
        image[:, column - 1 : column + 1] = 255
    return image


def _in_band(
    values: Float[np.ndarray, "h w"], band: tuple[float, float]
) -> Bool[np.ndarray, "h w"]:
    low, high = min(band), max(band)
    return (values >= low) & (values <= high)


def compose(
    size: tuple[int, int],
    panes: Sequence[Pane],
    images: Sequence[PaneImages],
    scales: Scales,
    settings: Settings,
) -> UInt8[np.ndarray, "h w 3"]:
    """The picture alone, without marks and scales, [H, W, 3]."""
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
