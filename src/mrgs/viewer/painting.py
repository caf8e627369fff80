"""Values to colours (palettes, isotherm, blends), and marks, titles and scale bars over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from mrgs.pictures import drawing
from mrgs.pictures.drawing import Scale
from mrgs.pictures.palette import display_range
from mrgs.pictures.values import full_scale, unit_of
from mrgs.scene import Camera, Modality, SceneBounds, TemperatureRange
from mrgs.viewer.panes import Pane, PaneImages, PaneKind, PanePoint
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
    """A picture of a camera and what it was made of; pixels without marks and scales, [H, W, 3]."""

    camera: Camera
    panes: tuple[Pane, ...]
    images: tuple[PaneImages, ...]
    scales: Scales
    pixels: Colors

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.camera.width, self.camera.height

    def place(self, x: float, y: float) -> PanePoint | None:
        """The pane and the place in it at a place of the picture (x to the right, y down, 0 to 1);
        None between the panes."""
        for pane in self.panes:
            u = (x * self.camera.width - pane.left) / pane.camera.width
            v = (y * self.camera.height - pane.top) / pane.camera.height
            if 0 <= u < 1 and 0 <= v < 1:
                return PanePoint(pane, u, v)
        return None


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
            values = shown.depth
            if ball is not None:  # the background is infinitely far
                camera = pane.camera.resized(*values.shape[::-1])
                values = ball.without_background(camera, torch.from_numpy(values)).numpy()
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
    """Join images [H, W, 3] at a white line; the right one takes ``share`` of the width."""
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
    """The picture without marks and scales, [H, W, 3]; each pane's images are stretched to it."""
    painted = [
        paint(pane, shown, scales, settings) for pane, shown in zip(panes, images, strict=True)
    ]
    if len(panes) == 1 and painted[0].shape[1::-1] == size:
        return painted[0]
    picture = drawing.blank(size, EMPTY_COLOR)
    for pane, colors in zip(panes, painted, strict=True):
        part = Image.fromarray(np.ascontiguousarray(colors))
        wanted = (pane.camera.width, pane.camera.height)
        if part.size != wanted:
            part = part.resize(wanted, Image.Resampling.BILINEAR)
        picture.paste(part, (pane.left, pane.top))
    return np.asarray(picture)


TEXT_PX = 14
CROSS_PX, STROKE_PX, DOT_PX = 9, 2, 4
SCALE_FROM_PX = 180
"""Panes lower than this have no room for a scale bar."""

HIDDEN_BEHIND = 1.05
"""A mark whose point is this much deeper than what is seen there is hidden by it."""


@dataclass(frozen=True, eq=False)
class MarkLabel:
    """A mark with its label, and a short one for little room: world coordinates of its corners, of
    a spot its middle, [N, 3]; and of the smallest and the largest value, empty for none."""

    corners: Float[np.ndarray, "n 3"]
    label: str
    short: str = ""
    closed: bool = False
    low_at: tuple[float, ...] = ()
    high_at: tuple[float, ...] = ()


class SeenLabel(NamedTuple):
    """A ``MarkLabel`` in a pane; places are x and y from 0 to 1 over it, None where hidden."""

    corners: list[tuple[float, float]]
    closed: bool
    label: str
    low: tuple[float, float] | None
    high: tuple[float, float] | None
    short: str


def annotate(drawn: DrawnPicture, labels: Sequence[MarkLabel]) -> Colors:
    """A picture [H, W, 3] for a file: with its marks, titles and scale bars drawn in."""
    whole = Image.fromarray(drawn.pixels)
    for pane, shown in zip(drawn.panes, drawn.images, strict=True):
        place = (pane.left, pane.top, pane.left + pane.camera.width, pane.top + pane.camera.height)
        part = whole.crop(place)
        for seen in seen_labels(pane, shown, labels):
            _draw_label(part, seen)
        if pane.title:
            _draw_card(part, (8, 8), drawing.fit_text(pane.title, TEXT_PX, part.width - 32))
        scale = pane_scale(pane, drawn.scales)
        if scale is not None and part.height >= SCALE_FROM_PX:
            _draw_scale(part, scale)
        whole.paste(part, (pane.left, pane.top))
    return np.asarray(whole)


def pane_scale(pane: Pane, scales: Scales) -> Scale | None:
    """The scale to draw over a pane; None for a pane of colours alone, and for a photo, which has
    that of the model beside it."""
    key = pane.kind if pane.kind in OWN_SCALE else pane.scaled
    return None if key is None or pane.kind == "photo" else scales.get(key)


def seen_labels(pane: Pane, images: PaneImages, labels: Sequence[MarkLabel]) -> list[SeenLabel]:
    """Where a pane shows marks; without those that have no visible corner, or reach behind it."""
    found = []
    for each in labels:
        pixels, _ = pane.camera.project(torch.from_numpy(each.corners))
        if not bool(pixels.isfinite().all()):
            continue
        if not any(_seen_place(pane, images, corner) for corner in each.corners):
            continue
        size = pixels.new_tensor([pane.camera.width, pane.camera.height])
        corners = [(x, y) for x, y in (pixels / size).tolist()]
        low, high = (_seen_place(pane, images, at) for at in (each.low_at, each.high_at))
        found.append(SeenLabel(corners, each.closed, each.label, low, high, each.short))
    return found


def _seen_place(
    pane: Pane, images: PaneImages, point: Sequence[float] | Float[np.ndarray, "3"]
) -> tuple[float, float] | None:
    """Where a pane shows a world point, x and y from 0 to 1; None outside or behind a surface."""
    if not len(point):
        return None
    camera = pane.camera
    pixel, distance = camera.project(torch.from_numpy(np.asarray(point, np.float64)))
    if not camera.contains(pixel):
        return None
    x, y = (pixel / pixel.new_tensor([camera.width, camera.height])).tolist()
    if images.depth is not None:
        height, width = images.depth.shape
        if distance.item() > HIDDEN_BEHIND * images.depth[int(y * height), int(x * width)]:
            return None
    return x, y


def _draw_label(image: Image.Image, seen: SeenLabel) -> None:
    corners = [(x * image.width, y * image.height) for x, y in seen.corners]
    if len(corners) == 1:
        x, y = (round(each) for each in corners[0])
        drawing.draw_strokes(image, drawing.cross(x, y, CROSS_PX), STROKE_PX)
        _draw_card(image, (x + 12, y - TEXT_PX - 10), seen.label)
        return
    drawing.draw_outline(image, corners, seen.closed, STROKE_PX)
    top = min(corners, key=lambda corner: corner[1])
    _draw_card(image, (top[0] + 6, top[1] - TEXT_PX - 12), seen.label)
    for place, color in ((seen.low, drawing.COLDEST), (seen.high, drawing.HOTTEST)):
        if place is not None:
            at = place[0] * image.width, place[1] * image.height
            drawing.draw_dot(image, at, DOT_PX, color)


def _draw_card(image: Image.Image, corner: tuple[float, float], text: str) -> None:
    """A line of text on a white card, moved into the image."""
    width, height = round(drawing.text_width(text, TEXT_PX)) + 12, TEXT_PX + 8
    x = max(0, min(round(corner[0]), image.width - width))
    y = max(0, min(round(corner[1]), image.height - height))
    ImageDraw.Draw(image).rounded_rectangle((x, y, x + width, y + height), 4, fill=drawing.PAPER)
    drawing.draw_text(image, (x + 6, y + height // 2), text, TEXT_PX, drawing.INK, anchor="lm")


def _draw_scale(image: Image.Image, scale: Scale) -> None:
    """A scale bar on a white card in the lower left corner."""
    bar = drawing.scale_bar(scale, min(260, image.height - 80), "vertical", TEXT_PX)
    left, top = 8, image.height - bar.height - 24
    card = (left, top, left + bar.width + 16, image.height - 8)
    ImageDraw.Draw(image).rounded_rectangle(card, 4, fill=drawing.PAPER)
    image.paste(bar, (left + 8, top + 8))
