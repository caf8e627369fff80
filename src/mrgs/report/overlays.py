"""Marks over pictures: rings, outlines, and names that do not cover each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np
from jaxtyping import Bool, Float64
from PIL import Image, ImageDraw

from mrgs.marks.mark import Mark
from mrgs.pictures.drawing import INK, Box, draw_plate, draw_strokes, fit_text, text_width

LABEL_PX = 24
SMALL_PX = 420
MARK, RIM = (200, 70, 0), (255, 255, 255)
WHITE, BLACK = (255, 255, 255), (0, 0, 0)
RING_PX, STROKE_PX = 13, 3
MANY = 15
"""Names from which on they are written in smaller letters."""

SMALL_LABEL_PX = 18
MOST_STEPS = 6
"""Heights of a name that it may stand away from its place."""


def draw_marks(
    image: Image.Image, marks: Mapping[str, Mark], places: Mapping[str, Float64[np.ndarray, "_ 2"]]
) -> None:
    """A ring about each spot and the outline of the other marks, then their names.

    Args:
        image: to draw on.
        marks: by name.
        places: pixels of the corners of those that are drawn.
    """
    for name, corners in places.items():
        path = [*map(tuple, corners)]
        if marks[name].kind == "spot":
            _draw_ring(image, *corners[0])
        else:
            draw_strokes(image, [[*path, path[0]] if marks[name].is_area else path], STROKE_PX)
    middles = {name: corners.mean(axis=0) for name, corners in places.items()}
    draw_names(image, {name: (float(x), float(y)) for name, (x, y) in middles.items()})


def _draw_ring(image: Image.Image, x: float, y: float) -> None:
    """White between two black lines."""
    draw = ImageDraw.Draw(image)
    for radius, color, width in ((RING_PX + 1, BLACK, 5), (RING_PX, WHITE, 3)):
        draw.ellipse([x - radius, y - radius, x + radius, y + radius], outline=color, width=width)


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


def draw_names(image: Image.Image, places: Mapping[str, tuple[float, float]]) -> dict[str, Box]:
    """Write names beside their places, so that none covers another, nor another's place: where
    there are many, in smaller letters, and farther away where it is crowded. A name for which there
    is no room is left out. Returns the boxes of the others."""
    size = LABEL_PX if len(places) < MANY else SMALL_LABEL_PX
    labels = {name: fit_text(name, size, image.width / 2) for name in places}
    boxes = _boxes_of(image, labels, places, size)
    for name, box in boxes.items():
        (x, y), (left, top, right, bottom) = places[name], box
        end = (min(max(x, left), right), min(max(y, top), bottom))
        ImageDraw.Draw(image).line((x, y, *end), fill=INK, width=2)
    for name, box in boxes.items():
        draw_plate(image, box, labels[name], size)
    return boxes


def _boxes_of(
    image: Image.Image,
    labels: Mapping[str, str],
    places: Mapping[str, tuple[float, float]],
    size: int,
) -> dict[str, Box]:
    """Boxes for the names that there is room for."""
    taken = np.zeros((image.height, image.width), bool)
    for x, y in places.values():
        taken[_pixels_of((x - RING_PX, y - RING_PX, x + RING_PX, y + RING_PX))] = True
    found = {}
    for name, (x, y) in places.items():
        wide, half = text_width(labels[name], size) + size / 2, size / 2 + 4
        for box in _boxes_about(x, y, wide, half):
            if _is_free(box, taken):
                found[name] = box
                taken[_pixels_of(box)] = True
                break
    return found


def _boxes_about(x: float, y: float, wide: float, half: float) -> Iterator[Box]:
    """Boxes of a size to the right and to the left of a place, then above and below it; the nearest
    first."""
    for distance in range(MOST_STEPS):
        away = RING_PX + 2 + 2 * half * distance
        for down in range(-distance - 1, distance + 2):
            middle = y + 2 * half * down
            for left in (x + away, x - away - wide):
                yield left, middle - half, left + wide, middle + half
        for middle in (y - away - half, y + away + half):
            yield x - wide / 2, middle - half, x + wide / 2, middle + half


def _is_free(box: Box, taken: Bool[np.ndarray, "h w"]) -> bool:
    """Whether a box lies in an image and on no pixel that is taken: by one look, however many other
    boxes there are."""
    left, top, right, bottom = box
    height, width = taken.shape
    inside = left >= 0 and top >= 0 and right <= width and bottom <= height
    return inside and not taken[_pixels_of(box)].any()


def _pixels_of(box: Box) -> tuple[slice, slice]:
    """Rows and columns that a box touches, from the image's first on."""
    left, top, right, bottom = box
    return (
        slice(max(math.floor(top), 0), max(math.ceil(bottom), 0)),
        slice(max(math.floor(left), 0), max(math.ceil(right), 0)),
    )
