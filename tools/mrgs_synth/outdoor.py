"""Outdoor surfaces for generated scenes: masonry, plaster, roof tiles, snow, leaves and a clear
winter sky."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter, map_coordinates

from mrgs_synth.textures import Colour, Texture, blend, noise


@dataclass(frozen=True, eq=False)
class SnowCover:
    """Snow over a rectangle: one mask for its look and for its temperature.

    Attributes:
        share: how much of each cell is covered, 0 to 1; row 0 is the edge with the largest second
            coordinate.
        low: smallest first and second coordinate of the rectangle, metres.
        high: largest first and second coordinate, metres.
    """

    share: Float[np.ndarray, "rows columns"]
    low: tuple[float, float]
    high: tuple[float, float]

    @classmethod
    def scattered(
        cls,
        shape: tuple[int, int],
        low: tuple[float, float],
        high: tuple[float, float],
        amount: float,
        rng: np.random.Generator,
    ) -> SnowCover:
        """Patches that cover about ``amount`` of the rectangle, with soft edges."""
        field = noise(shape[0], shape[1], (6, 8), rng)
        limit = np.quantile(field, 1.0 - amount)
        return cls(np.clip((field - limit) / 0.05 + 0.5, 0.0, 1.0), low, high)

    def at(
        self, first: Float[np.ndarray, " n"], second: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """How much of the surface is covered at points, 0 to 1."""
        rows, columns = self.share.shape
        column = (first - self.low[0]) / (self.high[0] - self.low[0]) * columns - 0.5
        row = (self.high[1] - second) / (self.high[1] - self.low[1]) * rows - 0.5
        sampled: Float[np.ndarray, " n"] = map_coordinates(
            self.share, [row, column], order=1, mode="nearest"
        )
        return sampled

    def over(self, ground: Texture, rng: np.random.Generator) -> Texture:
        """A texture of the same shape with the snow on it."""
        height, width = self.share.shape
        snow = blend((196, 206, 222), (250, 252, 255), noise(height, width, (20, 28), rng))
        weight = self.share[..., None]
        return np.round(ground * (1.0 - weight) + snow * weight).astype(np.uint8)


def bricks(height: int, width: int, brick: tuple[int, int], rng: np.random.Generator) -> Texture:
    """Running bond of bricks of (rows, columns) pixels, each with its own shade, in grey mortar."""
    image = Image.fromarray(
        blend((150, 142, 132), (186, 178, 168), noise(height, width, (24, 40), rng))
    )
    draw = ImageDraw.Draw(image)
    tones = [
        (150, 72, 52),
        (168, 84, 58),
        (132, 60, 48),
        (178, 104, 74),
        (112, 56, 50),
        (188, 120, 88),
    ]
    joint = max(brick[0] // 7, 1)
    for row, top in enumerate(range(0, height, brick[0])):
        for left in range(-(row % 2) * brick[1] // 2, width, brick[1]):
            tone = np.array(tones[rng.integers(len(tones))]) * rng.uniform(0.8, 1.12)
            colour = tuple(int(c) for c in tone.clip(0, 255))
            draw.rectangle(
                (left, top, left + brick[1] - joint - 1, top + brick[0] - joint - 1), fill=colour
            )
    return _grainy(np.asarray(image), 0.3, rng)


def _grainy(texture: Texture, amount: float, rng: np.random.Generator) -> Texture:
    """A texture whose pixels differ by a share ``amount`` of their brightness."""
    height, width = texture.shape[:2]
    grain = 1.0 + amount * (gaussian_filter(rng.uniform(size=(height, width)), 0.8) - 0.5)
    return np.round(texture * grain[..., None]).clip(0, 255).astype(np.uint8)


def plaster(height: int, width: int, colour: Colour, rng: np.random.Generator) -> Texture:
    """Weathered render: blotches, grain, and streaks that rain has left."""
    blotches = noise(height, width, (5, 9), rng)
    grain = rng.uniform(size=(height, width))
    streaks = np.cumsum(rng.normal(size=(1, width)), axis=1)
    streaks = (
        gaussian_filter(np.sin(0.25 * streaks), (0, 3)) * np.linspace(1.0, 0.2, height)[:, None]
    )
    shade = 0.55 + 0.5 * (blotches - 0.5) + 0.16 * (grain - 0.5) + 0.12 * streaks
    return blend(
        (int(colour[0] * 0.66), int(colour[1] * 0.66), int(colour[2] * 0.68)), colour, shade
    )


def roof_tiles(height: int, width: int, rows: int, rng: np.random.Generator) -> Texture:
    """Courses of clay tiles, row 0 at the ridge."""
    image = Image.fromarray(np.full((height, width, 3), (60, 40, 36), dtype=np.uint8))
    draw = ImageDraw.Draw(image)
    tall = height // rows
    for row in range(rows):
        for left in range(-(row % 2) * tall // 2, width, tall):
            tone = rng.uniform(0.7, 1.1)
            colour = (int(150 * tone), int(82 * tone), int(62 * tone))
            draw.rounded_rectangle(
                (left, row * tall - tall // 3, left + tall - 2, (row + 1) * tall - 2),
                tall // 3,
                fill=colour,
            )
    return np.asarray(image)


def grass(height: int, width: int, rng: np.random.Generator) -> Texture:
    """Tired winter lawn with blades, bare soil and fallen leaves."""
    base = blend((70, 62, 40), (124, 128, 74), noise(height, width, (14, 18), rng))
    image = Image.fromarray(_grainy(base, 0.9, rng))
    draw = ImageDraw.Draw(image)
    for _ in range(height * width // 1500):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        size = rng.uniform(1.5, 4.5)
        colour = [(150, 96, 40), (176, 130, 60), (108, 66, 36)][rng.integers(3)]
        draw.ellipse((x - size, y - size * 0.6, x + size, y + size * 0.6), fill=colour)
    return np.asarray(image)


def paving(height: int, width: int, slab: int, rng: np.random.Generator) -> Texture:
    """Square concrete slabs with dark joints."""
    image = Image.fromarray(
        blend((126, 122, 116), (178, 172, 164), noise(height, width, (10, 10), rng))
    )
    draw = ImageDraw.Draw(image)
    for top in range(0, height, slab):
        for left in range(0, width, slab):
            tone = int(rng.uniform(112, 186))
            draw.rectangle(
                (left + 1, top + 1, left + slab - 3, top + slab - 3),
                fill=(tone, tone - 3, tone - 8),
            )
            draw.line((left, top, left + slab, top), fill=(70, 68, 62), width=3)
            draw.line((left, top, left, top + slab), fill=(70, 68, 62), width=3)
    return _grainy(np.asarray(image), 0.3, rng)


def leaves(height: int, width: int, rng: np.random.Generator) -> Texture:
    """Evergreen leaves before the dark inside of a hedge."""
    image = Image.fromarray(np.full((height, width, 3), (20, 30, 20), dtype=np.uint8))
    draw = ImageDraw.Draw(image)
    for _ in range(height * width // 28):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        a, b = rng.uniform(3, 7), rng.uniform(2, 4)
        tone = rng.uniform(0.5, 1.25)
        draw.ellipse(
            (x - a, y - b, x + a, y + b), fill=(int(52 * tone), int(92 * tone), int(46 * tone))
        )
    return np.asarray(image)


def clear_sky(
    glow: tuple[float, float], rng: np.random.Generator, shape: tuple[int, int] = (128, 256)
) -> Float[np.ndarray, "h w 3"]:
    """A cloudless sky before sunrise: pale above the horizon, blue above, brightest towards the
    glow.

    Args:
        glow: direction of the brightest part: azimuth clockwise from +y and elevation, degrees.
        rng: of faint streaks of haze.
        shape: rows from the zenith to the nadir, and columns once around, clockwise from +y.

    Returns:
        Radiance per colour.
    """
    rows, columns = shape
    elevation = np.radians(90.0 - (np.arange(rows) + 0.5) / rows * 180.0)[:, None]
    azimuth = np.radians((np.arange(columns) + 0.5) / columns * 360.0)[None, :]
    at, up = np.radians(glow[0]), np.radians(glow[1])
    cosine = np.sin(elevation) * np.sin(up) + np.cos(elevation) * np.cos(up) * np.cos(azimuth - at)
    bright = np.exp((cosine - 1.0) / 0.08)[..., None]
    height = np.clip(np.sin(elevation), 0.0, 1.0)[..., None] ** 0.45
    haze = 1.0 + 0.1 * (noise(rows, columns, (12, 3), rng)[..., None] - 0.5)
    radiance = (1.0 - height) * np.array([0.86, 0.84, 0.84]) + height * np.array([0.3, 0.46, 0.8])
    radiance = radiance * haze + 4.5 * bright * np.array([1.0, 0.88, 0.74])
    return np.where(elevation[..., None] > 0.0, radiance, 0.25 * np.ones(3))
