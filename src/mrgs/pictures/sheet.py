"""Sheets of pictures: sections of labelled rows under column titles, with scale bars below."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw

from mrgs.pictures.drawing import (
    HAIRLINE,
    INK,
    MUTED,
    Scale,
    blank,
    draw_text,
    fit_text,
    scale_bar,
    text_width,
)

MARGIN_PX = 32
GAP_PX = 8
TITLE_PX = 30
"""Height of the title of a section, and of the line of column titles."""

CAPTION_PX = 18
BARS_PX = 58
HEADING_PX = 60


class Panel(NamedTuple):
    """A picture (sRGB) in a row with a caption, or a text in place of one that is missing."""

    image: UInt8[np.ndarray, "h w 3"] | None
    caption: str = ""
    missing: str = "-"


class PanelRow(NamedTuple):
    """A row of a section. ``figures`` are caption and value of the lines below the label."""

    label: str
    panels: Sequence[Panel]
    figures: Sequence[tuple[str, str]] = ()


class Bar(NamedTuple):
    """A scale bar below a section with a line below it, from the first to the last of two columns;
    without them, bars share the width of all columns equally."""

    scale: Scale
    note: str
    columns: tuple[int, int] | None = None


def draw_section(
    columns: Sequence[str],
    rows: Sequence[PanelRow],
    bars: Sequence[Bar],
    *,
    cell_px: int,
    label_px: int,
    title: str = "",
) -> Image.Image:
    """Draw rows of pictures, under an optional title; a picture is as large as its cell allows, in
    its middle, and ``cell_px`` wide, labels ``label_px``."""
    lefts = [label_px + index * (cell_px + GAP_PX) for index in range(len(columns))]
    top = TITLE_PX * (2 if title else 1)
    heights = [_picture_height(row, cell_px) for row in rows]
    pitches = [
        height + GAP_PX + CAPTION_PX * any(panel.caption for panel in row.panels)
        for row, height in zip(rows, heights, strict=True)
    ]
    size = (lefts[-1] + cell_px, top + sum(pitches) + (BARS_PX if bars else 0))
    section, y = blank(size), top
    draw_text(section, (0, 20), fit_text(title, 18, section.width), 18, INK, bold=True)
    for left, text in zip(lefts, columns, strict=True):
        draw_text(section, (left, top - 10), fit_text(text, 15, cell_px), 15, INK)
    for row, height, pitch in zip(rows, heights, pitches, strict=True):
        draw_text(section, (0, y + 15), fit_text(row.label, 15, label_px - 14), 15, INK)
        for line, (caption, value) in enumerate(row.figures):
            draw_text(section, (0, y + 40 + 18 * line), caption, 12, MUTED)
            draw_text(section, (54, y + 40 + 18 * line), value, 12, INK)
        for left, panel in zip(lefts, row.panels, strict=True):
            _draw_panel(section, panel, (left, y), (cell_px, height))
        y += pitch
    _draw_bars(section, bars, lefts, cell_px, y + 4)
    return section


def draw_heading(
    width: int, title: str, line: str, numbers: Sequence[tuple[str, str]]
) -> Image.Image:
    """Draw a title and a line on the left, and large numbers with their captions on the right, as
    many as there is room for."""
    heading = blank((width, HEADING_PX))
    right = float(width)
    for caption, value in reversed(numbers):
        number_px = max(text_width(value, 22), text_width(caption, 13))
        if right - number_px < 260:
            break
        draw_text(heading, (right, 24), value, 22, INK, anchor="rs")
        draw_text(heading, (right, 44), caption, 13, MUTED, anchor="rs")
        right -= number_px + 34
    draw_text(heading, (0, 24), fit_text(title, 28, right), 28, INK, bold=True)
    draw_text(heading, (0, 44), fit_text(line, 13, right), 13, MUTED)
    ImageDraw.Draw(heading).line([(0, 58), (width, 58)], fill=HAIRLINE)
    return heading


def stack(pictures: Sequence[Image.Image]) -> Image.Image:
    """The pictures one below the other, with a margin around all of them."""
    width = max(picture.width for picture in pictures)
    height = sum(picture.height for picture in pictures) + GAP_PX * (len(pictures) - 1)
    sheet, y = blank((width + 2 * MARGIN_PX, height + 2 * MARGIN_PX)), MARGIN_PX
    for picture in pictures:
        sheet.paste(picture, (MARGIN_PX, y))
        y += picture.height + GAP_PX
    return sheet


def _picture_height(row: PanelRow, cell_px: int) -> int:
    """Height of the tallest picture at the cell's width, but no taller than 4:3 upright."""
    images = [panel.image for panel in row.panels if panel.image is not None]
    heights = [round(cell_px * image.shape[0] / image.shape[1]) for image in images]
    return min(max([*heights, cell_px // 2]), cell_px * 4 // 3)


def _draw_panel(
    section: Image.Image, panel: Panel, corner: tuple[int, int], size: tuple[int, int]
) -> None:
    (x, y), (width, height) = corner, size
    if panel.image is None:
        draw_text(section, (x + width / 2, y + height / 2), panel.missing, 18, MUTED, anchor="mm")
    else:
        image = Image.fromarray(panel.image)
        scale = min(width / image.width, height / image.height)
        fitted = max(1, round(image.width * scale)), max(1, round(image.height * scale))
        smooth = Image.Resampling.LANCZOS if scale < 1 else Image.Resampling.BICUBIC
        middle = x + (width - fitted[0]) // 2, y + (height - fitted[1]) // 2
        section.paste(image.resize(fitted, smooth), middle)
    draw_text(section, (x, y + height + 14), fit_text(panel.caption, 12, width), 12, MUTED)


def _draw_bars(
    section: Image.Image, bars: Sequence[Bar], lefts: Sequence[int], cell_px: int, y: int
) -> None:
    share = (section.width - lefts[0] + 40) // max(1, len(bars))
    for index, bar in enumerate(bars):
        start, length = lefts[0] + index * share, share - 40
        if bar.columns is not None:
            start, end = (lefts[column] for column in bar.columns)
            length = end + cell_px - start
        drawn = scale_bar(bar.scale, length, "horizontal")
        section.paste(drawn, (start, y))
        draw_text(
            section, (start, y + drawn.height + 14), fit_text(bar.note, 12, length), 12, MUTED
        )
