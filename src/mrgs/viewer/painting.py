"""Values to colours: palettes, isotherm, blends; then marks, scale bars and titles on top."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

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
from mrgs.viewer.settings import Settings, in_kelvin

ISOTHERM_COLOR = (0, 230, 118)
ISOTHERM_ON_RAINBOW = (255, 0, 220)
"""Green stands in the rainbow already."""

EMPTY_COLOR = (38, 41, 48)
"""Around the panes."""

NO_SURFACE_COLOR = (58, 66, 78)
"""Where there is no value: bluish, so that it is neither a cold place nor a grey one."""

TEXT_PX = 14
SCALE_FROM_PX = 180
"""Panes lower than this have no room for a scale bar."""

HIDDEN_BEHIND = 1.05
"""A mark whose point lies this much deeper than what is seen there is hidden by it."""


@dataclass(frozen=True, eq=False)
class PointLabel:
    """A labelled point.

    Attributes:
        position: world coordinates, [3].
        label: drawn beside it.
        short: the same where there is no room for the label; may be empty.
    """

    position: Float[np.ndarray, "3"]
    label: str
    short: str = ""


@dataclass(frozen=True, eq=False)
class Outline:
    """A line or an area on a surface.

    Attributes:
        corners: world coordinates, [N, 3].
        closed: whether the last corner is joined to the first.
        label: drawn beside it.
        low_at: world coordinates of the smallest value, [3]; empty if there is none.
        high_at: of the largest value.
        short: see ``PointLabel``.
    """

    corners: Float[np.ndarray, "n 3"]
    closed: bool
    label: str
    low_at: tuple[float, ...] = ()
    high_at: tuple[float, ...] = ()
    short: str = ""


class SeenOutline(NamedTuple):
    """An outline in a pane; all places are x and y from 0 to 1 over it.

    Attributes:
        corners: of the outline.
        closed: see ``Outline``.
        label: see ``Outline``.
        low: place of the smallest value; None where that is hidden.
        high: place of the largest value; None where that is hidden.
        short: see ``PointLabel``.
    """

    corners: list[tuple[float, float]]
    closed: bool
    label: str
    low: tuple[float, float] | None
    high: tuple[float, float] | None
    short: str


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
    """The picture alone, without marks and scales, [H, W, 3].

    Args:
        size: width and height of the picture.
        panes: its parts.
        images: of each pane, at any size; they are stretched to the pane.
        scales: what the colours mean.
        settings: palette, isotherm, slider.
    """
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


def annotate(
    picture: UInt8[np.ndarray, "h w 3"],
    panes: Sequence[Pane],
    images: Sequence[PaneImages],
    scales: Scales,
    marks: Sequence[PointLabel] = (),
    outlines: Sequence[Outline] = (),
) -> UInt8[np.ndarray, "h w 3"]:
    """A picture [H, W, 3] for a file: with its marks, titles and scale bars drawn in.

    Args:
        picture: as ``compose`` makes it.
        panes: its parts.
        images: of each pane.
        scales: what the colours mean.
        marks: points to label where they are seen.
        outlines: lines and areas to draw where they are seen.
    """
    whole = Image.fromarray(picture)
    for pane, shown in zip(panes, images, strict=True):
        place = (pane.left, pane.top, pane.left + pane.camera.width, pane.top + pane.camera.height)
        part = whole.crop(place)
        for outline in seen_outlines(pane, shown, outlines):
            _draw_outline(part, outline)
        for mark in seen_marks(pane, shown, marks):
            _draw_mark(part, mark)
        if pane.title:
            _draw_card(part, (8, 8), fit_text(pane.title, TEXT_PX, part.width - 32))
        scale = pane_scale(pane, scales)
        if scale is not None and part.height >= SCALE_FROM_PX:
            _draw_scale(part, scale)
        whole.paste(part, (pane.left, pane.top))
    return np.asarray(whole)


def pane_scale(pane: Pane, scales: Scales) -> Scale | None:
    """The scale to draw over a pane; that of the model is also that of the photo beside it."""
    return None if pane.kind == "photo" else scales.of(pane)


def seen_marks(
    pane: Pane, images: PaneImages, marks: Sequence[PointLabel]
) -> list[tuple[float, float, str, str]]:
    """Where a pane shows marks: x and y from 0 to 1 over the pane, the label, and that for little
    room; without those that lie outside or behind something."""
    places = []
    size = pane.camera.width, pane.camera.height
    for mark in marks:
        pixel, depth = pane.camera.project(torch.from_numpy(mark.position))
        if not pane.camera.contains(pixel):
            continue
        x, y = pixel.tolist()
        if not _is_hidden((x, y, depth.item()), images, size):
            places.append((x / size[0], y / size[1], mark.label, mark.short))
    return places


def seen_outlines(pane: Pane, images: PaneImages, outlines: Sequence[Outline]) -> list[SeenOutline]:
    """Where a pane shows outlines; without those of which no corner is seen, or that reach behind
    the camera."""
    found = []
    for outline in outlines:
        pixels, _ = pane.camera.project(torch.from_numpy(outline.corners))
        if not bool(pixels.isfinite().all()):
            continue
        if not any(_seen_place(pane, images, corner) for corner in outline.corners):
            continue
        size = pixels.new_tensor([pane.camera.width, pane.camera.height])
        corners = [(x, y) for x, y in (pixels / size).tolist()]
        low, high = (_seen_place(pane, images, at) for at in (outline.low_at, outline.high_at))
        found.append(SeenOutline(corners, outline.closed, outline.label, low, high, outline.short))
    return found


def _seen_place(
    pane: Pane, images: PaneImages, point: Sequence[float] | Float[np.ndarray, "3"]
) -> tuple[float, float] | None:
    """Where a pane shows a point of the world, x and y from 0 to 1; None where it is hidden."""
    if not len(point):
        return None
    pixel, depth = pane.camera.project(torch.tensor([float(each) for each in point]).double())
    size = pane.camera.width, pane.camera.height
    if not pane.camera.contains(pixel):
        return None
    x, y = pixel.tolist()
    return None if _is_hidden((x, y, depth.item()), images, size) else (x / size[0], y / size[1])


def _draw_mark(image: Image.Image, mark: tuple[float, float, str, str]) -> None:
    x, y, label = round(mark[0] * image.width), round(mark[1] * image.height), mark[2]
    draw = ImageDraw.Draw(image)
    for color, width in (((0, 0, 0), 4), ((255, 255, 255), 2)):
        draw.line([(x - 9, y), (x + 9, y)], fill=color, width=width)
        draw.line([(x, y - 9), (x, y + 9)], fill=color, width=width)
    _draw_card(image, (x + 12, y - TEXT_PX - 10), label)


def _is_hidden(
    place: tuple[float, float, float], images: PaneImages, size: tuple[int, int]
) -> bool:
    """Whether a surface occludes a point (x, y, z-depth); never without depth (photos)."""
    if images.depth is None:
        return False
    height, width = images.depth.shape
    seen = images.depth[int(place[1] / size[1] * height), int(place[0] / size[0] * width)]
    return bool(place[2] > HIDDEN_BEHIND * seen)


def _draw_outline(image: Image.Image, outline: SeenOutline) -> None:
    draw = ImageDraw.Draw(image)
    corners = [(x * image.width, y * image.height) for x, y in outline.corners]
    path = [*corners, corners[0]] if outline.closed else corners
    for color, width in (((0, 0, 0), 4), ((255, 255, 255), 2)):
        draw.line(path, fill=color, width=width, joint="curve")
    top = min(corners, key=lambda corner: corner[1])
    _draw_card(image, (top[0] + 6, top[1] - TEXT_PX - 12), outline.label)
    for place, color in ((outline.low, (70, 150, 255)), (outline.high, (255, 70, 60))):
        if place is not None:
            x, y = place[0] * image.width, place[1] * image.height
            draw.ellipse((x - 4, y - 4, x + 4, y + 4), fill=color, outline=(255, 255, 255), width=1)


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
