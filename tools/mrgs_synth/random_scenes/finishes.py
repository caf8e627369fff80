"""Materials of random scenes: how surfaces look, and how they emit and reflect heat."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial

import numpy as np

from mrgs_synth import outdoor, textures
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.stage import Material, Solid
from mrgs_synth.textures import Colour, Texture

EMISSIVITY = {"matte": (0.88, 0.98), "glossy": (0.8, 0.96), "metal": (0.05, 0.5)}
"""By finish: paint, plaster, wood and plastic; bare metal."""
GLASS_EMISSIVITY = (0.85, 0.9)
MIRROR_BELOW = 0.3
"""Metals of a lower emissivity are polished and show an image of what is around them."""


def emissive(solids: Iterable[Solid], draw: Draw) -> tuple[Solid, ...]:
    """The solids with an emissivity drawn for each of those that are still black bodies."""
    return tuple(
        replace(solid, material=_emissive(solid.material, draw))
        if solid.material.emissivity == 1.0
        else solid
        for solid in solids
    )


def _emissive(material: Material, draw: Draw) -> Material:
    emissivity = draw.between(*EMISSIVITY[material.finish])
    return replace(
        material,
        emissivity=emissivity,
        heat_mirror=material.finish == "metal" and emissivity < MIRROR_BELOW,
    )


def glass(draw: Draw, texture: Texture | None = None) -> Material:
    """A pane; the texture is what is seen in and behind it."""
    if texture is None:
        texture = textures.plain(draw.colour((0.1, 0.4), (0.08, 0.25)), draw.rng, 64)
    return Material(
        texture, "glossy", 0.05, emissivity=draw.between(*GLASS_EMISSIVITY), heat_mirror=True
    )


def painted(draw: Draw, colour: Colour | None = None) -> Material:
    """A painted or lacquered surface, plastic, enamel."""
    texture = textures.plain(colour or draw.colour(), draw.rng, 64)
    return Material(texture, "glossy", draw.between(0.15, 0.4))


def matte(draw: Draw, colour: Colour | None = None) -> Material:
    """Cloth, cardboard, unglazed pottery."""
    return Material(textures.plain(colour or draw.colour(), draw.rng, 64))


def bare_metal(draw: Draw) -> Material:
    """Steel, aluminium, zinc, copper or brass, polished to dull."""
    colour = draw.one_of(
        (206, 208, 212), (176, 178, 184), (226, 226, 228), (214, 150, 110), (216, 184, 110)
    )
    return Material(textures.plain(colour, draw.rng, 64), "metal", draw.between(0.2, 0.45))


def wooden(draw: Draw, planks: int = 1) -> Material:
    """Boards, dark to light, raw or varnished."""
    tone = draw.between(0.5, 1.25)
    dark: Colour = (round(92 * tone), round(58 * tone), round(34 * tone))
    light: Colour = (round(190 * tone), round(142 * tone), round(96 * tone))
    texture = textures.wood(48 * max(planks, 2), 256, planks, draw.rng, dark, light)
    return Material(texture, draw.one_of("matte", "glossy"), 0.3)


def household(draw: Draw) -> Material:
    """Wood or paint."""
    return wooden(draw) if draw.chance(0.5) else painted(draw)


def bare_wall(draw: Draw, height: int, width: int, colour: Colour) -> Texture:
    """Painted smoothly: hardly anything to see."""
    depth = draw.between(0.02, 0.08)
    red, green, blue = (round(c * (1.0 - depth)) for c in colour)
    dark = (red, green, blue)
    return textures.blend(dark, colour, textures.noise(height, width, (3, 5), draw.rng))


def indoor_wall(draw: Draw, height: int, width: int) -> Texture:
    """A wall of a room, from nearly uniform to rich."""
    rng, colour = draw.rng, draw.colour((0.03, 0.35), (0.6, 0.95))
    second = draw.colour((0.1, 0.6), (0.3, 0.8))
    return draw.one_of(
        partial(bare_wall, draw, height, width, colour),
        partial(bare_wall, draw, height, width, colour),
        partial(outdoor.plaster, height, width, colour, rng),
        partial(textures.wallpaper, height, width, colour, second, draw.whole(30, 90), rng),
        partial(outdoor.bricks, height, width, (draw.whole(12, 20), draw.whole(36, 60)), rng),
        partial(tiled, draw, height, width, draw.whole(24, 60), colour),
        partial(textures.wood, height, width, draw.whole(8, 24), rng),
    )()


def floor(draw: Draw, size: int = 768) -> Texture:
    """A floor: boards, parquet, tiles, carpet, concrete."""
    rng, colour = draw.rng, draw.colour((0.03, 0.3), (0.3, 0.7))
    return draw.one_of(
        partial(textures.wood, size, size, draw.whole(10, 24), rng),
        partial(textures.parquet, size, draw.one_of(8, 12, 16), rng),
        partial(tiled, draw, size, size, draw.whole(50, 110), colour),
        partial(bare_wall, draw, size, size, colour),
        partial(outdoor.paving, size, size, draw.whole(60, 140), rng),
        partial(concrete, draw, size),
    )()


def tiled(draw: Draw, height: int, width: int, side: int, colour: Colour) -> Texture:
    """Square tiles with joints, each of its own shade."""
    rows, columns = -(-height // side), -(-width // side)
    tones = np.repeat(np.repeat(draw.rng.uniform(0.86, 1.0, (rows, columns)), side, 0), side, 1)
    tones = tones[:height, :width] * (0.96 + 0.04 * textures.noise(height, width, (8, 8), draw.rng))
    joint = np.minimum(np.arange(height)[:, None] % side, np.arange(width)[None, :] % side) < 2
    tones[joint] *= draw.between(0.5, 0.8)
    return np.round(tones[..., None] * np.array(colour)).clip(0, 255).astype(np.uint8)


def concrete(draw: Draw, size: int = 512) -> Texture:
    """Grey, blotched, with stains."""
    grey = draw.whole(120, 180)
    ground = textures.blend(
        (grey - 50, grey - 50, grey - 52),
        (grey, grey, grey - 4),
        textures.noise(size, size, (6, 6), draw.rng),
    )
    stain = (grey - 62, grey - 64, grey - 70)
    return textures.speckles(ground, stain, draw.whole(10, 120), size / 160, draw.rng)


def clay(draw: Draw, height: int, width: int) -> Texture:
    """Roof tiles of some colour, row 0 at the ridge."""
    tiles = np.array(outdoor.roof_tiles(height, width, draw.whole(10, 26), draw.rng))
    tint = np.array(draw.colour((0.0, 0.5), (0.4, 1.0))) / 150.0
    return (tiles * tint).clip(0, 255).astype(np.uint8)


def outside_wall(draw: Draw, height: int, width: int) -> Texture:
    """A façade: render, brick, boards, sheets, panels."""
    rng, colour = draw.rng, draw.colour((0.03, 0.4), (0.5, 0.95))
    return draw.one_of(
        partial(outdoor.plaster, height, width, colour, rng),
        partial(bare_wall, draw, height, width, colour),
        partial(outdoor.bricks, height, width, (draw.whole(9, 14), draw.whole(24, 36)), rng),
        partial(textures.wood, height, width, draw.whole(14, 40), rng),
        partial(tiled, draw, height, width, draw.whole(90, 200), colour),
    )()
