"""A figure of image panels: blocks of rows under common column titles, scale bars below each
block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from mrgs.pictures.drawing import INK, MUTED, PAPER, Scale, draw_text, fit_text, scale_bar

MARGIN_PX = 24
LABEL_PX = 96
GAP_PX = 6
TITLE_PX = 26
CAPTION_PX = 18
BARS_PX = 54
BLOCK_TITLE_PX = 30


class Panel(NamedTuple):
    """An image and the figures below it; without an image, ``missing`` is written in its place."""

    image: UInt8[np.ndarray, "h w 3"] | None
    caption: str = ""
    missing: str = "–"


@dataclass(frozen=True, eq=False)
class Block:
    """One scene: labelled rows of panels, and what their colours mean.

    Attributes:
        title: above the rows.
        rows: label and panels, as many as there are columns.
        bars: scales and what each is of.
    """

    title: str
    rows: Sequence[tuple[str, Sequence[Panel]]]
    bars: Sequence[tuple[Scale, str]]


def as_drawn(block: Block, cell_px: int) -> Block:
    """The block with every image resized to its final size, for panels ``cell_px`` wide."""
    rows = [
        (
            label,
            [
                panel
                if panel.image is None
                else panel._replace(image=_resized(panel.image, cell_px))
                for panel in row
            ],
        )
        for label, row in block.rows
    ]
    return replace(block, rows=rows)


def draw_figure(columns: Sequence[str], blocks: Sequence[Block], cell_px: int) -> Image.Image:
    """Draw all blocks, one below the other; every panel is ``cell_px`` wide.

    Raises:
        ValueError: there is nothing to draw.
    """
    if not columns or not blocks:
        raise ValueError("a figure needs at least one column and one block")
    width = 2 * MARGIN_PX + LABEL_PX + len(columns) * (cell_px + GAP_PX) - GAP_PX
    height = 2 * MARGIN_PX + TITLE_PX + sum(_block_height(block, cell_px) for block in blocks)
    figure = Image.new("RGB", (width, height), PAPER)
    left = [MARGIN_PX + LABEL_PX + index * (cell_px + GAP_PX) for index in range(len(columns))]
    for x, title in zip(left, columns, strict=True):
        draw_text(
            figure,
            (x + cell_px / 2, MARGIN_PX + 14),
            fit_text(title, 15, cell_px),
            15,
            INK,
            anchor="ms",
        )
    y = MARGIN_PX + TITLE_PX
    for block in blocks:
        _draw_block(figure, block, left, y, cell_px)
        y += _block_height(block, cell_px)
    return figure


def _block_height(block: Block, cell_px: int) -> int:
    rows = sum(_row_height(panels, cell_px) + CAPTION_PX + GAP_PX for _, panels in block.rows)
    return BLOCK_TITLE_PX + rows + (BARS_PX if block.bars else 0)


def _row_height(panels: Sequence[Panel], cell_px: int) -> int:
    heights = [
        round(cell_px * panel.image.shape[0] / panel.image.shape[1])
        for panel in panels
        if panel.image is not None
    ]
    return max([*heights, cell_px // 3])


def _draw_block(
    figure: Image.Image, block: Block, left: Sequence[int], y: int, cell_px: int
) -> None:
    room = figure.width - 2 * MARGIN_PX
    draw_text(figure, (MARGIN_PX, y + 20), fit_text(block.title, 18, room), 18, INK, bold=True)
    y += BLOCK_TITLE_PX
    for label, panels in block.rows:
        height = _row_height(panels, cell_px)
        draw_text(
            figure,
            (MARGIN_PX, y + height / 2),
            fit_text(label, 14, LABEL_PX - 8),
            14,
            MUTED,
            anchor="lm",
        )
        for x, panel in zip(left, panels, strict=True):
            _draw_panel(figure, panel, (x, y), cell_px, height)
        y += height + CAPTION_PX + GAP_PX
    if block.bars:
        length = (left[-1] + cell_px - left[0] - 40 * (len(block.bars) - 1)) // len(block.bars)
        for index, (scale, text) in enumerate(block.bars):
            x = left[0] + index * (length + 40)
            bar = scale_bar(scale, length, "horizontal")
            figure.paste(bar, (x, y + 2))
            draw_text(figure, (x, y + bar.height + 14), fit_text(text, 12, length), 12, MUTED)


def _draw_panel(
    figure: Image.Image, panel: Panel, corner: tuple[int, int], width: int, height: int
) -> None:
    x, y = corner
    middle = x + width / 2
    if panel.image is None:
        draw_text(figure, (middle, y + height / 2), panel.missing, 18, MUTED, anchor="mm")
    else:
        figure.paste(Image.fromarray(_resized(panel.image, width)), (x, y))
    draw_text(
        figure,
        (middle, y + height + 13),
        fit_text(panel.caption, 12, width),
        12,
        MUTED,
        anchor="ms",
    )


def _resized(pixels: UInt8[np.ndarray, "h w 3"], width: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The image at this width; the same pixels where it has it already."""
    image = Image.fromarray(pixels)
    size = (width, max(1, round(image.height * width / image.width)))
    smooth = Image.Resampling.LANCZOS if image.width > width else Image.Resampling.BICUBIC
    return np.asarray(image.resize(size, smooth))
