"""Marks over pictures: rings, outlines, and names that do not cover each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from PIL import Image, ImageDraw

from mrgs.marks.mark import Mark
from mrgs.pictures.drawing import INK, Box, draw_plate, text_width

LABEL_PX = 24
SMALL_PX = 420
MARK, RIM = (200, 70, 0), (255, 255, 255)
WHITE, BLACK = (255, 255, 255), (0, 0, 0)
PLACES = [(1, -1), (1, 1), (-1, -1), (-1, 1), (1, -3), (1, 3), (-1, -3), (-1, 3)]
"""Where a label is tried, beside its mark: the side, and half heights of a label down."""


def draw_ring(image: Image.Image, x: float, y: float, radius: int = 13) -> None:
    """A ring about a place, white between two black lines."""
    draw = ImageDraw.Draw(image)
    for size, color, width in ((radius + 1, BLACK, 5), (radius, WHITE, 3)):
        draw.ellipse([x - size, y - size, x + size, y + size], outline=color, width=width)


def draw_outline(image: Image.Image, corners: Sequence[tuple[float, ...]]) -> None:
    """A line through places, white between two black lines."""
    draw = ImageDraw.Draw(image)
    for color, width in ((BLACK, 6), (WHITE, 3)):
        draw.line([*corners], fill=color, width=width, joint="curve")


def draw_place(
    image: Image.Image, mark: Mark, corners: Float64[np.ndarray, "n 2"], radius: float
) -> None:
    """A dot for a spot, the outline of the other kinds, at pixels of a plan."""
    draw, path = ImageDraw.Draw(image), [*map(tuple, corners)]
    if mark.is_area:
        path.append(path[0])
    for color, wider in ((RIM, 4), (MARK, 0)):
        if mark.kind != "spot":
            draw.line(path, fill=color, width=round(radius) + wider, joint="curve")
    x, y = np.mean(corners, axis=0)
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), MARK, RIM, 2)


def small_picture(image: Image.Image) -> Image.Image:
    """A picture for beside others: at most ``SMALL_PX`` wide and high."""
    share = SMALL_PX / max(image.size)
    size = round(image.width * share), round(image.height * share)
    return image.resize(size, Image.Resampling.LANCZOS)


def draw_name(image: Image.Image, x: float, y: float, name: str, taken: Sequence[Box]) -> Box:
    """Write a name beside a place where no other stands, if there is such a place; returns the box
    that it takes up."""
    wide, half = text_width(name, LABEL_PX) + 12, LABEL_PX / 2 + 4

    def box_at(side: int, down: int) -> Box:
        left = x + 12 if side > 0 else x - 12 - wide
        left = min(max(left, 0), image.width - wide)
        middle = min(max(y + down * half, half), image.height - half)
        return left, middle - half, left + wide, middle + half

    boxes = [box_at(*place) for place in PLACES]
    free = [box for box in boxes if not any(_overlap(box, other) for other in taken)]
    left, top, right, bottom = box = (free or boxes)[0]
    end = (min(max(x, left), right), (top + bottom) / 2)
    ImageDraw.Draw(image).line((x, y, *end), fill=INK, width=2)
    draw_plate(image, box, name, LABEL_PX)
    return box


def _overlap(one: Sequence[float], other: Sequence[float]) -> bool:
    return all(one[i] < other[i + 2] and other[i] < one[i + 2] for i in (0, 1))
