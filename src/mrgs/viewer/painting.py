"""Values to colours: palettes, isotherm, blends; then marks, scale bars and titles on top."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw

from mrgs.pictures.drawing import (
    INK,
    PAPER,
    Scale,
    blank,
    draw_text,
    fit_text,
    scale_bar,
    text_width,
)
from mrgs.pictures.palette import PaletteName, display_range
from mrgs.pictures.values import full_scale, unit_of
from mrgs.scene import Camera, Modality, Reach, TemperatureRange
from mrgs.viewer.fields import PaneImages
from mrgs.viewer.layout import Pane
from mrgs.viewer.picking import Box, BoxReading
from mrgs.viewer.settings import Settings

ISOTHERM_COLOR = (0, 230, 118)
ISOTHERM_ON_RAINBOW = (255, 0, 220)
"""Green stands in the rainbow already."""

EMPTY_COLOR = (38, 41, 48)
"""Around the panes."""

TEXT_PX = 14
SCALE_FROM_PX = 180
"""Panes lower than this have no room for a scale bar."""

HIDDEN_BEHIND = 1.05
"""A mark whose point lies this much deeper than what is seen there is hidden by it."""


@dataclass(frozen=True, eq=False)
class Mark:
    """A labelled point.

    Attributes:
        position: world coordinates, [3].
        label: drawn beside it.
    """

    position: Float[np.ndarray, "3"]
    label: str


@dataclass(frozen=True)
class Scales:
    """The scales of a picture's colours; None or absent for what it does not show.

    Attributes:
        values: of each one-channel modality.
        depth: from far to near.
        difference: model minus photo, even about zero.
    """

    values: Mapping[Modality, Scale] = field(default_factory=dict)
    depth: Scale | None = None
    difference: Scale | None = None

    def of(self, pane: Pane) -> Scale | None:
        """The scale of a pane's colours; None for a pane of colours alone."""
        if pane.kind == "difference":
            return self.difference
        if pane.kind == "depth":
            return self.depth
        return None if pane.scaled is None else self.values.get(pane.scaled)


def measure_scales(
    panes: Sequence[Pane],
    images: Sequence[PaneImages],
    settings: Settings,
    temperature: TemperatureRange | None,
    ball: Reach | None = None,
) -> Scales:
    """The scales that suit a picture: the limits that the user has set, else percentiles of what is
    seen; intensities are always shown from 0 to 1.

    Args:
        panes: of the picture.
        images: of each pane.
        settings: the user's choices.
        temperature: the scale of the thermal values; None without known °C.
        ball: how far the scene reaches; the background beyond it does not count on the scale of the
            depth. None if there is none.
    """
    values: dict[Modality, list[np.ndarray]] = {}
    depth, errors = [], []
    unit = ""
    for pane, shown in zip(panes, images, strict=True):
        modality = pane.scaled
        if pane.kind == "depth" and shown.depth is not None:
            depth.append(_scene_depth(pane.camera, shown.depth, ball)[shown.solid])
        elif pane.kind == "difference" and modality is not None:
            errors.append(np.abs(shown.images[modality][shown.solid]))
            unit = unit_of(modality, temperature)
        elif modality is not None:
            values.setdefault(modality, []).append(shown.images[modality][shown.solid])
    if settings.limits is not None:
        values.setdefault(settings.scaled, [])
    near_far = display_range(np.concatenate(depth)) if depth else None
    largest = display_range(np.concatenate(errors))[1] if errors else None
    return Scales(
        {each: _scale_of(each, seen, settings, temperature) for each, seen in values.items()},
        None if near_far is None else Scale("depth", near_far[1], near_far[0], ""),
        None if largest is None else Scale("error", -largest, largest, unit),
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
    if modality == settings.scaled and settings.limits is not None:
        low, high = settings.limits
    elif modality.is_metric:
        low, high = display_range(np.concatenate(seen))
    else:
        return scale
    return scale._replace(low=low, high=high)


def _scene_depth(
    camera: Camera, depth: Float[np.ndarray, "h w"], ball: Reach | None
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
        return scales.depth.colorize(images.depth)
    if pane.kind == "difference":
        (modality,) = pane.modalities
        assert scales.difference is not None
        return scales.difference.colorize(images.images[modality])
    painted = [_paint_modality(each, images, scales, settings) for each in pane.modalities]
    if pane.kind in ("blend", "split"):
        below, above = painted
        return (blend if pane.kind == "blend" else split)(below, above, settings.share)
    return painted[0]


def _paint_modality(
    modality: Modality, images: PaneImages, scales: Scales, settings: Settings
) -> UInt8[np.ndarray, "h w 3"]:
    """The colours of one modality: its own, or those of its scale and of the isotherm."""
    values = images.images[modality]
    if modality.channels > 1:
        return values
    # What the model does not cover has no temperature; the background's colour would look like a
    # cold one.
    shown = np.where(images.solid, values, np.nan) if modality.is_metric else values
    painted = scales.values[modality].colorize(shown)
    if modality == settings.scaled and settings.isotherm is not None:
        band = images.solid & _in_band(values, settings.isotherm)
        painted[band] = isotherm_color(settings.palette)
    return painted


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
    marks: Sequence[Mark] = (),
    boxes: Sequence[tuple[Box, Sequence[BoxReading | None]]] = (),
) -> UInt8[np.ndarray, "h w 3"]:
    """The whole picture with its marks, boxes, titles and scale bars.

    Args:
        size: width and height of the picture.
        panes: its parts.
        images: of each pane, at any size; they are stretched to the pane.
        scales: what the colours mean.
        settings: palette, isotherm, slider.
        marks: points to label where they are seen.
        boxes: rectangles to draw into every pane, each with what was read in each pane.
    """
    picture = blank(size, EMPTY_COLOR)
    for number, (pane, shown) in enumerate(zip(panes, images, strict=True)):
        part = Image.fromarray(np.ascontiguousarray(paint(pane, shown, scales, settings)))
        wanted = (pane.camera.width, pane.camera.height)
        if part.size != wanted:
            part = part.resize(wanted, Image.Resampling.BILINEAR)
        _draw_marks(part, pane, shown, marks)
        for name, (box, readings) in enumerate(boxes, start=1):
            _draw_box(part, box, f"B{name}", readings[number])
        if pane.title:
            _draw_card(part, (8, 8), fit_text(pane.title, TEXT_PX, part.width - 32))
        scale = scales.of(pane)
        # The bar of the model is also that of the photo beside it.
        if scale is not None and part.height >= SCALE_FROM_PX and pane.kind != "photo":
            _draw_scale(part, scale)
        picture.paste(part, (pane.left, pane.top))
    return np.asarray(picture)


def _draw_marks(image: Image.Image, pane: Pane, images: PaneImages, marks: Sequence[Mark]) -> None:
    draw = ImageDraw.Draw(image)
    for mark in marks:
        pixel, depth = pane.camera.project(torch.from_numpy(mark.position))
        if not pane.camera.contains(pixel) or _is_hidden(
            (*pixel.tolist(), depth.item()), images, image.size
        ):
            continue
        x, y = (round(value) for value in pixel.tolist())
        for color, width in (((0, 0, 0), 4), ((255, 255, 255), 2)):
            draw.line([(x - 9, y), (x + 9, y)], fill=color, width=width)
            draw.line([(x, y - 9), (x, y + 9)], fill=color, width=width)
        _draw_card(image, (x + 12, y - TEXT_PX - 10), mark.label)


def _is_hidden(
    place: tuple[float, float, float], images: PaneImages, size: tuple[int, int]
) -> bool:
    """Whether a surface occludes a point (x, y, z-depth); never without depth (photos)."""
    if images.depth is None:
        return False
    height, width = images.depth.shape
    seen = images.depth[int(place[1] / size[1] * height), int(place[0] / size[0] * width)]
    return bool(place[2] > HIDDEN_BEHIND * seen)


def _draw_box(image: Image.Image, box: Box, name: str, reading: BoxReading | None) -> None:
    draw = ImageDraw.Draw(image)
    corners = (
        box.u0 * image.width,
        box.v0 * image.height,
        box.u1 * image.width - 1,
        box.v1 * image.height - 1,
    )
    for color, width in (((0, 0, 0), 4), ((255, 255, 255), 2)):
        draw.rectangle(corners, outline=color, width=width)
    _draw_card(image, (corners[0], corners[1] - TEXT_PX - 9), name)
    if reading is None:
        return
    for extreme, color in ((reading.lowest, (70, 150, 255)), (reading.highest, (255, 70, 60))):
        x, y = extreme.u * image.width, extreme.v * image.height
        draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill=color, outline=(255, 255, 255), width=2)


def _draw_card(image: Image.Image, corner: tuple[float, float], text: str) -> None:
    """A line of text on a white card, moved so that it lies within the image."""
    width, height = round(text_width(text, TEXT_PX)) + 12, TEXT_PX + 8
    x = max(0, min(round(corner[0]), image.width - width))
    y = max(0, min(round(corner[1]), image.height - height))
    ImageDraw.Draw(image).rounded_rectangle((x, y, x + width, y + height), 4, fill=PAPER)
    draw_text(image, (x + 6, y + height // 2), text, TEXT_PX, INK, anchor="lm")


def _draw_scale(image: Image.Image, scale: Scale) -> None:
    """A scale bar on a white card in the lower left corner."""
    bar = scale_bar(scale, min(260, image.height - 80), "vertical", TEXT_PX)
    left, top = 8, image.height - bar.height - 24
    card = (left, top, left + bar.width + 16, image.height - 8)
    ImageDraw.Draw(image).rounded_rectangle(card, 4, fill=PAPER)
    image.paste(bar, (left + 8, top + 8))
