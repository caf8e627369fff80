"""Procedural sRGB textures: row 0 is the upper edge, sizes are in pixels."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFilter
from scipy.ndimage import zoom

Colour = tuple[int, int, int]
Texture = UInt8[np.ndarray, "h w 3"]


def noise(
    height: int, width: int, cells: tuple[int, int], rng: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    """Smooth noise in [0, 1]: four octaves, the coarsest with ``cells`` (rows, columns) bumps."""
    total = np.zeros((height, width))
    for octave in range(4):
        rows, columns = cells[0] * 2**octave + 1, cells[1] * 2**octave + 1
        grid = rng.uniform(size=(rows, columns))
        total += (
            zoom(grid, (height / rows, width / columns), order=1, grid_mode=True, mode="nearest")
            / 2**octave
        )
    low, high = total.min(), total.max()
    return (total - low) / (high - low)


def blend(dark: Colour, light: Colour, amount: Float[np.ndarray, "h w"]) -> Texture:
    """From one colour (0) to another (1)."""
    weight = amount[..., None].clip(0.0, 1.0)
    mixed = np.array(dark) * (1.0 - weight) + np.array(light) * weight
    return np.round(mixed).astype(np.uint8)


def plain(colour: Colour, rng: np.random.Generator, size: int = 128) -> Texture:
    """One colour, mottled by a fifth of its brightness."""
    shade = noise(size, size, (6, 6), rng)
    return blend(tuple(int(c * 0.8) for c in colour), colour, shade)  # type: ignore[arg-type]


def wood(
    height: int,
    width: int,
    planks: int,
    rng: np.random.Generator,
    dark: Colour = (92, 54, 28),
    light: Colour = (196, 140, 88),
) -> Texture:
    """Planks along the width, each with its own grain, shade and dark seam."""
    rows = []
    for top, bottom in zip(*_cuts(height, planks), strict=True):
        h = bottom - top
        across = np.linspace(0.0, 1.0, h)[:, None] * rng.uniform(1.5, 3.0)
        warp = noise(h, width, (2, 5), rng) * 2.5
        rings = 0.5 + 0.5 * np.sin(2.0 * np.pi * (across + warp) * 2.0)
        pores = noise(h, width, (max(h // 6, 2), 12), rng)
        shade = 0.5 * rings + 0.5 * pores + rng.uniform(-0.18, 0.18)
        shade[: max(h // 60, 1)] -= 0.6
        rows.append(shade)
    return blend(dark, light, np.concatenate(rows))


def _cuts(length: int, parts: int) -> tuple[list[int], list[int]]:
    edges = np.linspace(0, length, parts + 1).round().astype(int).tolist()
    return edges[:-1], edges[1:]


def parquet(size: int, boards: int, rng: np.random.Generator) -> Texture:
    """Square blocks of parquet, alternately turned."""
    blocks = []
    for row in range(boards):
        line = []
        for column in range(boards):
            side = size // boards
            block = wood(side, side, 4, rng, (104, 70, 42), (178, 134, 92))
            line.append(block if (row + column) % 2 else block.transpose(1, 0, 2))
        blocks.append(np.concatenate(line, axis=1))
    return np.concatenate(blocks)


def wallpaper(
    height: int, width: int, ground: Colour, ornament: Colour, repeat: int, rng: np.random.Generator
) -> Texture:
    """Mottled plaster with rows of diamonds and dots, every second row shifted."""
    image = Image.fromarray(blend(_darker(ground, 0.86), ground, noise(height, width, (8, 8), rng)))
    draw = ImageDraw.Draw(image)
    radius = repeat // 4
    for row, y in enumerate(range(repeat // 2, height, repeat)):
        for x in range(repeat // 2 if row % 2 else 0, width + repeat, repeat):
            draw.polygon(
                [(x, y - radius), (x + radius * 0.7, y), (x, y + radius), (x - radius * 0.7, y)],
                outline=ornament,
                width=3,
            )
            _dot(draw, x, y, radius * 0.25, ornament)
            _dot(draw, x + repeat // 2, y, radius * 0.15, ornament)
    return np.asarray(image)


def hang(
    wall: Texture,
    picture: UInt8[np.ndarray, "ph pw 3"],
    centre: tuple[int, int],
    frame: Colour = (70, 48, 34),
) -> Texture:
    """A wall's texture with a framed picture painted on it, centred at (row, column)."""
    edge, mount = 10, 16
    image = Image.fromarray(wall)
    draw = ImageDraw.Draw(image)
    top, left = centre[0] - picture.shape[0] // 2, centre[1] - picture.shape[1] // 2
    bottom, right = top + picture.shape[0], left + picture.shape[1]
    outer = edge + mount
    draw.rectangle((left - outer, top - outer, right + outer, bottom + outer), fill=frame)
    draw.rectangle((left - mount, top - mount, right + mount, bottom + mount), fill=(238, 232, 220))
    image.paste(Image.fromarray(picture), (left, top))
    return np.asarray(image)


def geometric(
    height: int, width: int, palette: list[Colour], shapes: int, rng: np.random.Generator
) -> Texture:
    """Discs, bars and triangles thrown over a ground of the palette's first colour: book covers,
    posters."""
    image = Image.fromarray(
        blend(_darker(palette[0], 0.85), palette[0], noise(height, width, (5, 5), rng))
    )
    draw = ImageDraw.Draw(image)
    for _ in range(shapes):
        colour = palette[int(rng.integers(1, len(palette)))]
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        size = rng.uniform(0.06, 0.2) * min(height, width)
        kind = int(rng.integers(3))
        if kind == 0:
            _dot(draw, x, y, size * 0.8, colour)
        elif kind == 1:
            draw.rectangle((x, y, x + 1.8 * size, y + 0.5 * size), fill=colour)
        else:
            draw.polygon([(x, y - size), (x + size, y + size), (x - size, y + size)], fill=colour)
    return np.asarray(image)


def title_page(height: int, width: int, palette: list[Colour], rng: np.random.Generator) -> Texture:
    """A book cover: a geometric picture, a title panel with bars for its letters, a border."""
    image = Image.fromarray(geometric(height, width, palette, 26, rng))
    draw = ImageDraw.Draw(image)
    margin = height // 14
    draw.rectangle(
        (margin, margin, width - margin, height - margin),
        outline=palette[1],
        width=max(height // 60, 2),
    )
    top = int(height * 0.16)
    draw.rectangle((width * 0.16, top, width * 0.84, height * 0.42), fill=(244, 238, 224))
    for line in range(3):
        length = width * rng.uniform(0.3, 0.58)
        y = top + height * (0.045 + 0.075 * line)
        draw.rectangle(
            (width * 0.21, y, width * 0.21 + length, y + height * 0.035), fill=(52, 44, 40)
        )
    return np.asarray(image)


def pages(height: int, width: int, rng: np.random.Generator) -> Texture:
    """The cut edge of a book: thin lines along the width."""
    lines = rng.uniform(0.2, 1.0, size=(height, 1)) * np.ones((1, width))
    return blend(
        (150, 134, 104), (244, 236, 214), 0.7 * lines + 0.3 * noise(height, width, (2, 8), rng)
    )


def bands(
    height: int, width: int, colours: list[tuple[float, Colour]], rng: np.random.Generator
) -> Texture:
    """Horizontal bands; each (upper limit as a share of the height, colour), from the top; slightly
    mottled."""
    v = (np.arange(height) + 0.5) / height
    which = np.searchsorted([limit for limit, _ in colours], v).clip(0, len(colours) - 1)
    flat = np.array([colour for _, colour in colours])[which][:, None, :]
    shade = 0.9 + 0.1 * noise(height, width, (6, 12), rng)[..., None]
    return np.round(flat * shade).astype(np.uint8)


def zigzag(
    texture: Texture, colour: Colour, centre: float, amplitude: float, teeth: int, thickness: int
) -> Texture:
    """A texture with a zigzag line around it, at a share of its height, that closes where the
    texture wraps around."""
    height, width = texture.shape[:2]
    x = np.linspace(0, width, 2 * teeth + 1)
    y = height * (centre + amplitude * np.where(np.arange(2 * teeth + 1) % 2, 1.0, -1.0))
    image = Image.fromarray(texture)
    ImageDraw.Draw(image).line(
        list(zip(x.tolist(), y.tolist(), strict=True)), fill=colour, width=thickness, joint="curve"
    )
    return np.asarray(image)


def speckles(
    texture: Texture, colour: Colour, count: int, radius: float, rng: np.random.Generator
) -> Texture:
    """A texture with dots thrown over it, of half to one and a half times the radius."""
    image = Image.fromarray(texture)
    draw = ImageDraw.Draw(image)
    height, width = texture.shape[:2]
    for _ in range(count):
        _dot(
            draw,
            rng.uniform(0, width),
            rng.uniform(0, height),
            radius * rng.uniform(0.5, 1.5),
            colour,
        )
    return np.asarray(image)


def weave(height: int, width: int, warp: list[Colour], weft: list[Colour], threads: int) -> Texture:
    """A checked cloth: stripes of the warp's colours across stripes of the weft's, thread by
    thread."""
    rows, columns = np.arange(height)[:, None], np.arange(width)[None, :]
    stripe = max(min(height, width) // threads, 2)
    across = np.array(weft)[(rows // stripe) % len(weft)] * np.ones((1, width, 1))
    along = np.array(warp)[(columns // stripe) % len(warp)] * np.ones((height, 1, 1))
    over = ((rows // 3 + columns // 3) % 2)[..., None]
    image = Image.fromarray((over * across + (1 - over) * along).astype(np.uint8))
    return np.asarray(image.filter(ImageFilter.GaussianBlur(1.0)))


def instrument_panel(height: int, width: int, rng: np.random.Generator) -> Texture:
    """The lid of an electronics case: ventilation slits, a sticker, coloured lights."""
    image = Image.fromarray(blend((38, 42, 48), (62, 68, 76), noise(height, width, (10, 14), rng)))
    draw = ImageDraw.Draw(image)
    for slit in range(9):
        x = width * (0.56 + 0.04 * slit)
        draw.rectangle((x, height * 0.14, x + width * 0.018, height * 0.86), fill=(8, 8, 10))
    draw.rectangle((width * 0.08, height * 0.14, width * 0.46, height * 0.58), fill=(232, 196, 60))
    for line in range(4):
        y = height * (0.2 + 0.09 * line)
        draw.rectangle(
            (width * 0.11, y, width * rng.uniform(0.25, 0.43), y + height * 0.035),
            fill=(40, 36, 24),
        )
    for light, colour in enumerate([(60, 220, 90), (250, 160, 40), (240, 70, 60), (80, 160, 250)]):
        _dot(draw, width * (0.11 + 0.1 * light), height * 0.78, height * 0.045, colour)
    return np.asarray(image)


def _darker(colour: Colour, factor: float) -> Colour:
    return (int(colour[0] * factor), int(colour[1] * factor), int(colour[2] * factor))


def _dot(draw: ImageDraw.ImageDraw, x: float, y: float, radius: float, colour: Colour) -> None:
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)
