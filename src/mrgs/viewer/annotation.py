"""Marks, titles and scale bars over the panes of a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from mrgs.pictures.drawing import (
    COLDEST,
    HOTTEST,
    INK,
    PAPER,
    Scale,
    cross,
    draw_dot,
    draw_strokes,
    draw_text,
    fit_text,
    scale_bar,
    text_width,
)
from mrgs.viewer.painting import DrawnPicture, Scales, scale_of
from mrgs.viewer.panes import Pane, PaneImages

TEXT_PX = 14
CROSS_PX, STROKE_PX, DOT_PX = 9, 2, 4
SCALE_FROM_PX = 180
"""Panes lower than this have no room for a scale bar."""

HIDDEN_BEHIND = 1.05
"""A mark whose point lies this much deeper than what is seen there is hidden by it."""


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


def annotate(drawn: DrawnPicture, labels: Sequence[MarkLabel]) -> UInt8[np.ndarray, "h w 3"]:
    """A picture [H, W, 3] for a file: with its marks, titles and scale bars drawn in."""
    whole = Image.fromarray(drawn.pixels)
    for pane, shown in zip(drawn.panes, drawn.images, strict=True):
        place = (pane.left, pane.top, pane.left + pane.camera.width, pane.top + pane.camera.height)
        part = whole.crop(place)
        for seen in seen_labels(pane, shown, labels):
            _draw_label(part, seen)
        if pane.title:
            _draw_card(part, (8, 8), fit_text(pane.title, TEXT_PX, part.width - 32))
        scale = pane_scale(pane, drawn.scales)
        if scale is not None and part.height >= SCALE_FROM_PX:
            _draw_scale(part, scale)
        whole.paste(part, (pane.left, pane.top))
    return np.asarray(whole)


def pane_scale(pane: Pane, scales: Scales) -> Scale | None:
    """The scale to draw over a pane; that of the model is also that of the photo beside it."""
    return None if pane.kind == "photo" else scale_of(pane, scales)


def seen_labels(pane: Pane, images: PaneImages, labels: Sequence[MarkLabel]) -> list[SeenLabel]:
    """Where a pane shows marks; without those of which no corner is seen, or that reach behind the
    camera."""
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
    """Where a pane shows a point of the world, x and y from 0 to 1; None outside of it and behind a
    surface, of which photos know none."""
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
        draw_strokes(image, cross(x, y, CROSS_PX), STROKE_PX)
        _draw_card(image, (x + 12, y - TEXT_PX - 10), seen.label)
        return
    draw_strokes(image, [[*corners, corners[0]] if seen.closed else corners], STROKE_PX)
    top = min(corners, key=lambda corner: corner[1])
    _draw_card(image, (top[0] + 6, top[1] - TEXT_PX - 12), seen.label)
    for place, color in ((seen.low, COLDEST), (seen.high, HOTTEST)):
        if place is not None:
            draw_dot(image, (place[0] * image.width, place[1] * image.height), DOT_PX, color)


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
