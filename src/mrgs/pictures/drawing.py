"""Text, strokes and scale bars on Pillow images, in the one font that comes with Pillow: ASCII, °,
± and · stand for the letters of other languages, and the minus sign is drawn."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Float64, UInt8
from PIL import Image, ImageDraw, ImageFont

from mrgs.pictures.palette import (
    INVALID_COLOR,
    PaletteName,
    palette_table,
    round_ticks,
    tick_labels,
)

INK = (24, 28, 36)
MUTED = (104, 111, 124)
HAIRLINE = (222, 225, 230)
PAPER = (255, 255, 255)
COLDEST, HOTTEST = (70, 150, 255), (255, 70, 60)
"""Dots at the smallest and the largest value of a mark."""

MINUS = "−"
_MINUS_SHARE = 0.09
"""Thickness of a minus sign, as a share of the size of the text."""

_KNOWN = f"°±·{MINUS}"
"""Characters beyond ASCII that are kept: the font has three, the minus sign is drawn."""

_REPLACED = str.maketrans(
    {"–": "-", "—": "-", "×": "x", "∞": "inf", "ß": "ss", "œ": "oe", "Œ": "Oe"}
    | {"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue"}
    | {"æ": "ae", "Æ": "Ae", "ø": "o", "Ø": "O", "ł": "l", "Ł": "L", "đ": "d", "Đ": "D"}
)

Box: TypeAlias = tuple[float, float, float, float]
"""Left, top, right and bottom, in pixels."""


class Scale(NamedTuple):
    """The meaning of a map's colours: values of the first and the last colour, the first larger
    where the palette runs the other way, the unit after the largest, the decimal sign."""

    palette: PaletteName
    low: float
    high: float
    unit: str
    decimal: str = "."

    def colorize(self, values: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
        """Colours of the values, [H, W]; NaN turns light grey."""
        position = (values - self.low) / (self.high - self.low)
        position = np.nan_to_num(position, nan=0.0, posinf=1.0, neginf=0.0).clip(0, 1)
        image = palette_table(self.palette)[np.rint(position * 255).astype(np.uint8)]
        image[np.isnan(values)] = INVALID_COLOR
        return image


def blank(size: tuple[int, int], color: tuple[int, int, int] = PAPER) -> Image.Image:
    """A picture of one colour, white by default; ``size`` is width and height in pixels."""
    return Image.new("RGB", size, color)


def draw_text(
    image: Image.Image,
    position: tuple[float | int, float | int],
    text: str,
    size: int,
    color: tuple[int, int, int] = INK,
    anchor: str = "ls",
    bold: bool = False,
) -> None:
    """Draw one line; ``anchor`` as in Pillow ("ls": position is the left end of the baseline)."""
    draw, font = ImageDraw.Draw(image), _font(size)
    text, vertical = drawable(text), anchor[1]
    left = position[0] - _BEFORE[anchor[0]] * text_width(text, size)
    for shift in (0.0, 0.5) if bold else (0.0,):
        x, y = left + shift, position[1]
        for number, part in enumerate(text.split(MINUS)):
            if number:
                _draw_minus(draw, (x, y), size, color, vertical)
                x += font.getlength("+")
            draw.text((x, y), part, font=font, fill=color, anchor=f"l{vertical}")
            x += font.getlength(part)


_BEFORE = {"l": 0.0, "m": 0.5, "r": 1.0}
"""Share of a line that is to the left of its position, by the first letter of the anchor."""


def _draw_minus(
    draw: ImageDraw.ImageDraw,
    position: tuple[float, float],
    size: int,
    color: tuple[int, int, int],
    vertical: str,
) -> None:
    """Draw the bar of the font's plus."""
    left, top, right, bottom = _font(size).getbbox("+", anchor=f"l{vertical}")
    margin = 0.12 * (right - left)
    thickness = max(1, round(_MINUS_SHARE * size))
    x, y = position
    first = round(y + (top + bottom - thickness) / 2)
    ends = round(x + left + margin), round(x + right - margin)
    draw.rectangle((ends[0], first, ends[1], first + thickness - 1), fill=color)


def draw_plate(image: Image.Image, box: Box, text: str, size: int) -> None:
    """Draw one line in white on a dark plate."""
    left, top, right, bottom = box
    ImageDraw.Draw(image).rounded_rectangle(box, 4, fill=INK)
    middle = ((left + right) / 2, (top + bottom) / 2)
    draw_text(image, middle, text, size, PAPER, anchor="mm")


def cross(x: float, y: float, reach: float) -> list[list[tuple[float, float]]]:
    """The strokes of a cross about a place."""
    return [[(x - reach, y), (x + reach, y)], [(x, y - reach), (x, y + reach)]]


def draw_strokes(
    image: Image.Image, paths: Sequence[Sequence[tuple[float, ...]]], width: int
) -> None:
    """Draw lines in white, each between two black ones, so that they are seen on any picture."""
    draw = ImageDraw.Draw(image)
    for color, wide in (((0, 0, 0), 2 * width), ((255, 255, 255), width)):
        for path in paths:
            draw.line([*path], fill=color, width=wide, joint="curve")


def draw_outline(
    image: Image.Image, corners: Sequence[tuple[float, ...]], closed: bool, width: int
) -> None:
    """Draw the strokes through some corners, of an area also back to the first."""
    draw_strokes(image, [[*corners, corners[0]] if closed else corners], width)


def draw_dot(
    image: Image.Image, place: Sequence[float], radius: int, color: tuple[int, int, int]
) -> None:
    """Draw a dot with a white rim."""
    x, y = place
    box = (x - radius, y - radius, x + radius, y + radius)
    ImageDraw.Draw(image).ellipse(box, fill=color, outline=PAPER, width=max(1, radius // 3))


def text_width(text: str, size: int) -> float:
    """Width of a line in pixels."""
    return _font(size).getlength(drawable(text).replace(MINUS, "+"))


def drawable(text: str) -> str:
    """The text in letters that the font has: without accents, ? for what it cannot write."""
    plain = unicodedata.normalize("NFKD", text.translate(_REPLACED))
    letters = (each for each in plain if not unicodedata.combining(each))
    return "".join(each if each.isascii() or each in _KNOWN else "?" for each in letters)


def fit_text(text: str, size: int, width: float | int) -> str:
    """The text, cut with dots where it is wider than ``width`` pixels."""
    if text_width(text, size) <= width:
        return text
    while text and text_width(text + "...", size) > width:
        text = text[:-1]
    return text.rstrip() + "..."


LABEL_PX, SMALL_LABEL_PX = 24, 18
MANY = 15
"""Names from which on they are written in smaller letters."""

MOST_STEPS = 6
"""Largest distance of a name from its place, in heights of the name."""

RING_PX = 13
"""Radius of a place that no name covers."""

Pixel: TypeAlias = tuple[float, float] | Float64[np.ndarray, "2"]


def draw_names(image: Image.Image, places: Mapping[str, Pixel]) -> dict[str, Box]:
    """Write names beside their places, x and y in pixels, so that none covers another, nor
    another's place: many in smaller letters, farther away where it is crowded, and none without
    room. Returns the boxes."""
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
    image: Image.Image, labels: Mapping[str, str], places: Mapping[str, Pixel], size: int
) -> dict[str, Box]:
    """Boxes for the names that there is room for."""
    taken = np.zeros((image.height, image.width), bool)
    for x, y in places.values():
        taken[_pixels_of((x - RING_PX, y - RING_PX, x + RING_PX, y + RING_PX))] = True
    found = {}
    for name, (x, y) in places.items():
        wide, half = text_width(labels[name], size) + size / 2, size / 2 + 4
        for box in _boxes_about(x, y, wide, half):
            left, top, right, bottom = box
            inside = left >= 0 and top >= 0 and right <= image.width and bottom <= image.height
            if inside and not taken[_pixels_of(box)].any():
                found[name] = box
                taken[_pixels_of(box)] = True
                break
    return found


def _boxes_about(x: float, y: float, wide: float, half: float) -> Iterator[Box]:
    """Boxes of a size to the sides of a place, then above and below it; the nearest first."""
    for distance in range(MOST_STEPS):
        away = RING_PX + 2 + 2 * half * distance
        for down in range(-distance - 1, distance + 2):
            middle = y + 2 * half * down
            for left in (x + away, x - away - wide):
                yield left, middle - half, left + wide, middle + half
        for middle in (y - away - half, y + away + half):
            yield x - wide / 2, middle - half, x + wide / 2, middle + half


def _pixels_of(box: Box) -> tuple[slice, slice]:
    """Rows and columns that a box touches, from the image's first on."""
    left, top, right, bottom = box
    return (
        slice(max(math.floor(top), 0), max(math.ceil(bottom), 0)),
        slice(max(math.floor(left), 0), max(math.ceil(right), 0)),
    )


def scale_bar(
    scale: Scale, length: int, direction: Literal["horizontal", "vertical"], size: int = 13
) -> Image.Image:
    """A colour bar with ticks at round numbers, ``length`` pixels long, the unit behind the last; a
    vertical one has its warm end on top. The image is as small as its content, on white."""
    return (_horizontal_bar if direction == "horizontal" else _vertical_bar)(scale, length, size)


def above_scale(picture: Image.Image, scale: Scale, size: int, gap: int) -> Image.Image:
    """A picture with its scale below, ``gap`` pixels apart, on white."""
    bar = scale_bar(scale, picture.width, "horizontal", size)
    whole = blank((picture.width, picture.height + bar.height + gap))
    whole.paste(picture, (0, 0))
    whole.paste(bar, (0, picture.height + gap))
    return whole


def _horizontal_bar(scale: Scale, length: int, size: int) -> Image.Image:
    thickness = max(8, round(0.8 * size))
    image = blank((length, thickness + 6 + round(1.4 * size)))
    ramp = palette_table(scale.palette)[np.linspace(0, 255, length).round().astype(int)]
    image.paste(Image.fromarray(np.repeat(ramp[None], thickness, axis=0)), (0, 0))
    draw = ImageDraw.Draw(image)
    end = length
    for value, label in _labelled_ticks(scale, max(2, length // (5 * size)))[
        :: -1 if scale.low < scale.high else 1
    ]:
        x = (value - scale.low) / (scale.high - scale.low) * (length - 1)
        width = text_width(label, size)
        left = min(max(x - width / 2, 0), length - width)
        draw.line([(x, thickness), (x, thickness + 4)], fill=MUTED)
        if left + width <= end:
            draw_text(image, (left, thickness + 6 + size), label, size, MUTED)
            end = round(left - 0.6 * size)
    return image


def _vertical_bar(scale: Scale, length: int, size: int) -> Image.Image:
    thickness = max(10, size)
    ticks = _labelled_ticks(scale, max(2, length // (3 * size)))
    width = (
        thickness + 10 + max((round(text_width(label, size)) for _, label in ticks), default=0) + 2
    )
    image = blank((width, length))
    ramp = palette_table(scale.palette)[np.linspace(255, 0, length).round().astype(int)]
    image.paste(Image.fromarray(np.repeat(ramp[:, None], thickness, axis=1)), (0, 0))
    draw = ImageDraw.Draw(image)
    for value, label in ticks:
        y = (scale.high - value) / (scale.high - scale.low) * (length - 1)
        draw.line([(thickness, y), (thickness + 4, y)], fill=MUTED)
        middle = min(max(y, size / 2), length - size / 2)
        draw_text(image, (thickness + 8, middle), label, size, MUTED, anchor="lm")
    return image


def _labelled_ticks(scale: Scale, count: int) -> list[tuple[float, str]]:
    ticks = round_ticks(scale.low, scale.high, count)
    labels = tick_labels(ticks, scale.decimal)
    if scale.palette == "error":
        labels = [
            f"+{label}" if tick > 0 else label for tick, label in zip(ticks, labels, strict=True)
        ]
    if labels and scale.unit:
        labels[-1] += f" {scale.unit}"
    return list(zip(ticks, labels, strict=True))


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=size)
