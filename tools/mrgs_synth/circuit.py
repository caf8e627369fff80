"""The look of a circuit board and of a bench: copper under solder mask, silkscreen, markings, a
cutting mat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mrgs_synth.shapes import Mesh, box
from mrgs_synth.textures import Colour, Texture, blend, noise

PIXELS_PER_MM = 10


@dataclass(frozen=True)
class Footprint:
    """Where a part sits on a board whose centre is (0, 0).

    Attributes:
        name: its reference designator, printed beside it.
        x_mm: its centre, to the right.
        y_mm: its centre, upwards.
        size_mm: of its body along x, y and upwards.
        pads: how its pads are laid out: a row on two sides, on four, two at its ends, a grid, or
            none.
        count: number of pads per row.
    """

    name: str
    x_mm: float
    y_mm: float
    size_mm: tuple[float, float, float]
    pads: Literal["two rows", "four rows", "ends", "grid", "none"] = "none"
    count: int = 1

    @property
    def centre_m(self) -> tuple[float, float]:
        """Its centre, metres."""
        return self.x_mm / 1000.0, self.y_mm / 1000.0

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Size of its body along x, y and upwards, metres."""
        length, width, height = self.size_mm
        return length / 1000.0, width / 1000.0, height / 1000.0

    def body(self, foot_m: float) -> Mesh:
        """A box of its size that stands at a height of foot_m metres above the origin."""
        return box(*self.size_m).placed(*self.centre_m, foot_m)


def board(
    size_mm: tuple[float, float], parts: Sequence[Footprint], title: str, rng: np.random.Generator
) -> Texture:
    """The upper side of a board: traces between the parts, vias, pads, outlines and names."""
    width, height = round(size_mm[0] * PIXELS_PER_MM), round(size_mm[1] * PIXELS_PER_MM)
    image = Image.fromarray(blend((10, 66, 42), (24, 96, 62), noise(height, width, (8, 12), rng)))
    draw = ImageDraw.Draw(image)
    _pours(draw, width, height, rng)
    _traces(draw, (width, height), parts, rng)
    for x, y in rng.uniform((20, 20), (width - 20, height - 20), (420, 2)):
        _disc(draw, x, y, 5, (190, 178, 120))
        _disc(draw, x, y, 2.2, (16, 30, 22))
    for part in parts:
        _footprint(draw, part, (width, height))
    for x in (40, width - 40):
        for y in (40, height - 40):
            _disc(draw, x, y, 32, (206, 190, 130))
            _disc(draw, x, y, 17, (20, 24, 22))
    draw.text((width * 0.36, height * 0.935), title, (240, 242, 236), ImageFont.load_default(34))
    return np.asarray(image)


def _pours(draw: ImageDraw.ImageDraw, width: int, height: int, rng: np.random.Generator) -> None:
    """Copper areas, lighter under the mask."""
    for _ in range(14):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        w, h = rng.uniform(80, 320), rng.uniform(60, 220)
        tone = rng.uniform(0.85, 1.1)
        colour = (int(34 * tone), int(122 * tone), int(78 * tone))
        draw.rounded_rectangle((x - w / 2, y - h / 2, x + w / 2, y + h / 2), 14, fill=colour)


def _traces(
    draw: ImageDraw.ImageDraw,
    size: tuple[int, int],
    parts: Sequence[Footprint],
    rng: np.random.Generator,
) -> None:
    """Buses of parallel traces that run between pairs of parts, straight and at 45°."""
    for _ in range(70):
        first, second = (parts[i] for i in rng.choice(len(parts), 2, replace=False))
        (x0, y0), (x1, y1) = _pixel(first, size), _pixel(second, size)
        dx, dy = x1 - x0, y1 - y0
        diagonal = min(abs(dx), abs(dy))
        bend = (
            (x1 - np.copysign(diagonal, dx), y0)
            if abs(dx) > abs(dy)
            else (x0, y1 - np.copysign(diagonal, dy))
        )
        lines, pitch = int(rng.integers(1, 7)), 9
        colour = [(52, 148, 96), (64, 162, 104), (44, 136, 90)][rng.integers(3)]
        for line in range(lines):
            shift = pitch * (line - lines / 2) + rng.integers(-60, 60) * (line == 0)
            path = [
                (x0 + shift, y0 + shift),
                (bend[0] + shift, bend[1] + shift),
                (x1 + shift, y1 + shift),
            ]
            draw.line(path, fill=colour, width=4 if lines > 1 else 9, joint="curve")


def _footprint(draw: ImageDraw.ImageDraw, part: Footprint, size: tuple[int, int]) -> None:
    x, y = _pixel(part, size)
    a, b = part.size_mm[0] / 2 * PIXELS_PER_MM, part.size_mm[1] / 2 * PIXELS_PER_MM
    white, tin = (236, 240, 232), (206, 202, 186)
    steps = np.linspace(-0.86, 0.86, part.count) if part.count > 1 else [0.0]
    for step in steps:
        if part.pads in ("two rows", "four rows"):
            for side in (-1, 1):
                _bar(draw, x + step * a, y + side * (b + 7), 2.6 * 14 / max(part.count, 6), 10, tin)
        if part.pads == "four rows":
            for side in (-1, 1):
                _bar(draw, x + side * (a + 7), y + step * b, 10, 2.6 * 14 / max(part.count, 6), tin)
        if part.pads == "grid":
            for other in (-0.45, 0.45):
                _disc(draw, x + step * a, y + other * b, 8, tin)
    if part.pads == "ends":
        for side in (-1, 1):
            _bar(draw, x + side * a, y, 7, b + 3, tin)
    margin = 16 if part.pads in ("two rows", "four rows", "ends") else 6
    if a > 25:
        draw.rectangle(
            (x - a - margin, y - b - margin, x + a + margin, y + b + margin), outline=white, width=2
        )
        _disc(draw, x - a - margin - 9, y - b - margin - 2, 5, white)
    letters = ImageFont.load_default(26 if a > 25 else 17)
    draw.text((x - a, y + b + margin + 1), part.name, white, letters)


def _pixel(part: Footprint, size: tuple[int, int]) -> tuple[float, float]:
    return size[0] / 2 + part.x_mm * PIXELS_PER_MM, size[1] / 2 - part.y_mm * PIXELS_PER_MM


def _bar(draw: ImageDraw.ImageDraw, x: float, y: float, a: float, b: float, colour: Colour) -> None:
    draw.rectangle((x - a, y - b, x + a, y + b), fill=colour)


def _disc(draw: ImageDraw.ImageDraw, x: float, y: float, radius: float, colour: Colour) -> None:
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)


def marked(
    lines: Sequence[str],
    size: tuple[int, int],
    rng: np.random.Generator,
    ground: Colour = (44, 44, 48),
    ink: Colour = (216, 216, 208),
) -> Texture:
    """The upper side of a part with its marking.

    Args:
        lines: text, from the top.
        size: width and height in pixels.
        rng: of the mould's grain.
        ground: colour of the body.
        ink: colour of the text.
    """
    width, height = size
    shade = 0.7 * noise(height, width, (5, 5), rng) + 0.3 * rng.uniform(size=(height, width))
    image = Image.fromarray(
        blend((int(ground[0] * 0.7), int(ground[1] * 0.7), int(ground[2] * 0.7)), ground, shade)
    )
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(max(int(0.72 * height / (len(lines) + 1)), 8))
    for number, line in enumerate(lines):
        draw.text((0.1 * width, height * (number + 0.55) / (len(lines) + 1)), line, ink, font)
    _disc(draw, 0.09 * width, 0.1 * height, 0.035 * min(size), ink)
    return np.asarray(image)


def cutting_mat(size_mm: tuple[float, float], rng: np.random.Generator) -> Texture:
    """A bench mat with a grid every 10 mm, numbers along its edges, and scratches."""
    pixels_per_mm = 4
    width, height = round(size_mm[0] * pixels_per_mm), round(size_mm[1] * pixels_per_mm)
    image = Image.fromarray(blend((34, 62, 96), (52, 88, 128), noise(height, width, (12, 16), rng)))
    draw = ImageDraw.Draw(image)
    step, pale, font = 10 * pixels_per_mm, (206, 220, 230), ImageFont.load_default(22)
    for number, x in enumerate(range(step, width - step + 1, step)):
        draw.line(
            (x, step, x, height - step), fill=(150, 176, 198), width=3 if number % 5 == 0 else 1
        )
        draw.text((x - 8, 8), str(number), pale, font)
    for number, y in enumerate(range(step, height - step + 1, step)):
        draw.line(
            (step, y, width - step, y), fill=(150, 176, 198), width=3 if number % 5 == 0 else 1
        )
        draw.text((6, y - 12), str(number), pale, font)
    for _ in range(90):
        x0, y0 = rng.uniform(0, width), rng.uniform(0, height)
        dx, dy = rng.normal(0, 60, 2)
        draw.line((x0, y0, x0 + dx, y0 + dy), fill=(92, 124, 156), width=2)
    draw.text(
        (0.62 * width, 0.86 * height), "ESD SAFE  A3", (226, 198, 90), ImageFont.load_default(64)
    )
    return np.asarray(image)


def winding(height: int, width: int, turns: int, rng: np.random.Generator) -> Texture:
    """Enamelled copper wire: bright turns across the width."""
    phase = np.linspace(0.0, 2.0 * np.pi * turns, height)[:, None] + 0.6 * noise(
        height, width, (6, 3), rng
    )
    return blend((96, 44, 22), (226, 140, 84), 0.5 + 0.5 * np.sin(phase))


def display(height: int, width: int, reading: str, rng: np.random.Generator) -> Texture:
    """The front of a multimeter: a display with its reading, a dial, jacks."""
    image = Image.fromarray(
        blend((196, 150, 20), (240, 196, 48), noise(height, width, (6, 4), rng))
    )
    draw = ImageDraw.Draw(image)
    draw.rounded_rectangle(
        (0.1 * width, 0.06 * height, 0.9 * width, 0.94 * height), 20, fill=(48, 50, 54)
    )
    draw.rectangle((0.17 * width, 0.11 * height, 0.83 * width, 0.32 * height), fill=(168, 186, 160))
    draw.text(
        (0.22 * width, 0.14 * height),
        reading,
        (26, 32, 28),
        ImageFont.load_default(int(0.14 * height)),
    )
    centre, radius = (0.5 * width, 0.57 * height), 0.23 * width
    for step in range(20):
        angle = 2.0 * np.pi * step / 20
        x, y = centre[0] + 1.25 * radius * np.cos(angle), centre[1] + 1.25 * radius * np.sin(angle)
        _disc(draw, x, y, 0.022 * width, [(230, 230, 226), (226, 90, 60), (240, 196, 60)][step % 3])
    _disc(draw, *centre, radius, (24, 26, 28))
    draw.line(
        (*centre, centre[0] + 0.9 * radius, centre[1] - 0.3 * radius),
        fill=(240, 240, 236),
        width=10,
    )
    for share, colour in ((0.27, (190, 40, 36)), (0.5, (30, 30, 32)), (0.73, (190, 40, 36))):
        _disc(draw, share * width, 0.86 * height, 0.05 * width, colour)
    return np.asarray(image)
