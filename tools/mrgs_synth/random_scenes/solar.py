"""Solar modules, sound and defective."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mrgs_synth import textures
from mrgs_synth.random_scenes import finishes
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.random_scenes.weather import Weather
from mrgs_synth.shapes import Mesh, box_faces, merge, without
from mrgs_synth.stage import Solid

MODULE_CELLS = (6, 10)
"""Cells of a solar module along its short and its long side."""


def modules(draw: Draw, weather: Weather, name: str, columns: int, rows: int) -> list[Solid]:
    """A field of solar modules on z = 0, its lower left corner at the origin; cells, strings of
    cells or whole modules may be defective."""
    wide, tall = (1.0, 1.65) if draw.chance(0.6) else (1.65, 1.0)
    across, along = MODULE_CELLS if wide < tall else MODULE_CELLS[::-1]
    gap = draw.between(0.01, 0.04)
    excess = _defects(draw, (rows * along, columns * across), (along, across))
    faces: list[Mesh] = []
    rims: list[Mesh] = []
    for row in range(rows):
        for column in range(columns):
            sides = box_faces(wide - gap, tall - gap, 0.04)
            at = ((column + 0.5) * wide, (row + 0.5) * tall, 0.06)
            faces.append(sides["top"].placed(*at))
            rims.append(without(sides, "top").placed(*at))
    lit_c = weather.air_c + 1.15 * weather.sun_c
    drift = draw.between(-0.4, 0.4)

    def celsius(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        i = (points[:, 1] / tall * along).astype(int).clip(0, excess.shape[0] - 1)
        j = (points[:, 0] / wide * across).astype(int).clip(0, excess.shape[1] - 1)
        edge = np.abs((points[:, 0] / wide) % 1.0 - 0.5) > 0.46
        return lit_c + excess[i, j] - 0.3 * edge + drift * points[:, 1]

    texture = _cells(draw, across, along)
    frame = finishes.bare_metal(draw) if draw.chance(0.6) else finishes.painted(draw, (30, 30, 32))
    return [
        Solid(f"{name}_glass", merge(faces), finishes.glass(draw, texture), celsius),
        Solid(f"{name}_rims", merge(rims), frame, weather.facing(0.9)),
    ]


def _defects(
    draw: Draw, shape: tuple[int, int], module: tuple[int, int]
) -> Float[np.ndarray, "rows columns"]:
    """How much hotter than the others each cell is, °C."""
    excess = draw.rng.normal(0.0, 0.25, shape)
    along, across = module
    for _ in range(draw.whole(0, 6)):
        i, j = draw.whole(0, shape[0] - 1), draw.whole(0, shape[1] - 1)
        excess[i, j] += draw.scale(3.0, 30.0)
    for _ in range(draw.whole(0, 2)):
        i = along * draw.whole(0, shape[0] // along - 1)
        j = across * draw.whole(0, shape[1] // across - 1)
        third = max(across // 3, 1)
        part = draw.one_of(slice(j, j + across), slice(j, j + third))
        excess[i : i + along, part] += draw.between(2.0, 7.0)
    return excess


def _cells(draw: Draw, across: int, along: int) -> textures.Texture:
    """Dark cells with bright lines between them."""
    side = 16
    tone = draw.one_of((22, 26, 40), (24, 34, 78), (18, 18, 20))
    cells = textures.plain(tone, draw.rng, 64)
    texture = np.array(np.tile(cells, (-(-along * side // 64), -(-across * side // 64), 1)))
    texture = texture[: along * side, : across * side]
    line = draw.one_of((150, 154, 160), (60, 62, 70))
    texture[::side] = texture[:, ::side] = line
    texture[:, side // 2 :: side] = tuple(min(c + 40, 255) for c in tone)
    return texture
