"""Maps of generated solar plants without a model: what a perfect one would show from above."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

from mrgs_synth.solar_plant.layout import (
    CELLS,
    FRAME_M,
    MODULE_M,
    TABLE_MODULES,
    Plant,
    drawn_plant,
)

FINER = 2
"""Rays of a pixel along each side."""

GROUND_C, FRAME_C = 34.0, 42.0
COLORS = {"ground": (90.0, 95.0, 60.0), "cell": (28.0, 36.0, 66.0), "frame": (190.0, 192.0, 195.0)}


class PlantMap(NamedTuple):
    """°C [H, W], colours [3, H, W] and points [H, W, 3] of a map, and the side of a pixel, m."""

    celsius: np.ndarray
    colors: np.ndarray
    points: np.ndarray
    pixel_m: float


@dataclass(frozen=True)
class Look:
    """How a map differs from an ideal one: the turn of the rows, ° counter-clockwise; standard
    deviations of the blur, m, and of the noise, K; depth by which glass seems lower, m; drift over
    the map, K; and the modules that are missing, (table, column, above)."""

    turn_deg: float = 0.0
    tilt_deg: float | None = None
    blur_m: float = 0.05
    noise_c: float = 0.15
    dip_m: float = 0.3
    drift_c: float = 3.0
    frames: float = 1.0
    missing: frozenset[tuple[int, int, int]] = frozenset()


def turned_plant(rows: int, modules: int, look: Look, seed: int) -> Plant:
    """A drawn plant with its rows turned about the origin, and another tilt."""
    plant = drawn_plant(rows, modules, 8.0, np.random.default_rng(seed))
    tables = plant.tables
    up = tables.up
    if look.tilt_deg is not None:
        angle = np.radians(look.tilt_deg)
        level = up * (1, 1, 0)
        level /= np.linalg.norm(level, axis=1, keepdims=True)
        up = np.cos(angle) * level + np.sin(angle) * np.array([0, 0, 1.0])
        up -= (up * tables.along).sum(axis=1, keepdims=True) * tables.along
        up /= np.linalg.norm(up, axis=1, keepdims=True)
    c, s = np.cos(np.radians(look.turn_deg)), np.sin(np.radians(look.turn_deg))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    turned = [each @ turn.T for each in (tables.corner, tables.along, up)]
    tables = replace(tables, corner=turned[0], along=turned[1], up=turned[2])
    return replace(plant, tables=tables)


def map_of(plant: Plant, look: Look, pixel_m: float = 0.05, seed: int = 0) -> PlantMap:
    """The map of a plant."""
    rng = np.random.default_rng(seed)
    tables = plant.tables
    size = np.array([TABLE_MODULES[0] * MODULE_M[0], TABLE_MODULES[1] * MODULE_M[1]])
    ends = tables.corner[:, None] + np.stack(
        [a * size[0] * tables.along + b * size[1] * tables.up for a in (0, 1) for b in (0, 1)], 1
    )
    low, high = ends.min(axis=(0, 1))[:2] - 4.0, ends.max(axis=(0, 1))[:2] + 4.0
    shape = np.ceil((high - low)[::-1] / pixel_m).astype(int) * FINER
    step = pixel_m / FINER
    celsius = GROUND_C + gaussian_filter(rng.normal(0, 1, shape), 20) * 60
    height = np.zeros(shape)
    colors = np.array(COLORS["ground"])[:, None, None] * (
        1 + gaussian_filter(rng.normal(0, 1, shape), 12) * 6
    )
    for table in range(len(tables.row)):
        corner, along, up = (each[table] for each in (tables.corner, tables.along, tables.up))
        near = (
            (ends[table, :, :2].min(axis=0) - low) / step,
            (ends[table, :, :2].max(axis=0) - low) / step,
        )
        left, bottom = np.floor(near[0]).astype(int) - 1
        right, top = np.ceil(near[1]).astype(int) + 1
        rows = slice(shape[0] - top, shape[0] - bottom)
        columns = slice(left, right)
        x = low[0] + step * (np.arange(left, right) + 0.5)
        y = low[1] + step * (np.arange(top, bottom, -1) - 0.5)
        flat = np.stack(np.meshgrid(x, y), axis=-1) - corner[:2]
        u, v = np.moveaxis(flat @ np.linalg.inv(np.stack([along[:2], up[:2]])), -1, 0)
        column, above = np.floor(u / MODULE_M[0]).astype(int), np.floor(v / MODULE_M[1]).astype(int)
        inside = (column >= 0) & (column < tables.modules[table]) & (above >= 0)
        inside &= above < TABLE_MODULES[1]
        for each in look.missing:
            if each[0] == table:
                inside &= (column != each[1]) | (above != each[2])
        a, b = u - column * MODULE_M[0] - FRAME_M, v - above * MODULE_M[1] - FRAME_M
        sides = [(m - 2 * FRAME_M) / n for m, n in zip(MODULE_M, CELLS, strict=True)]
        i, j = np.floor(a / sides[0]).astype(int), np.floor(b / sides[1]).astype(int)
        glass = inside & (i >= 0) & (i < CELLS[0]) & (j >= 0) & (j < CELLS[1])
        frame = inside & ~glass
        part = celsius[rows, columns]
        part[glass] = tables.cell_c[
            table, (above * CELLS[1] + j)[glass], (column * CELLS[0] + i)[glass]
        ]
        part[frame] = FRAME_C
        z = corner[2] + u * along[2] + v * up[2]
        dip = look.dip_m * np.clip(np.minimum(a, b).clip(0) * 4, 0, 1) * rng.uniform(0.3, 1)
        height[rows, columns][inside] = (z - np.where(glass, dip, 0))[inside]
        wire = np.minimum(a % sides[0], b % sides[1]) < 0.006
        cell = np.array(COLORS["cell"])
        color = colors[:, rows, columns]
        tone = tables.tone[table][above[glass], column[glass]]
        color[:, glass] = cell[:, None] * tone * np.where(wire[glass], 1.8, 1.0)
        frame_color = look.frames * np.array(COLORS["frame"]) + (1 - look.frames) * cell
        color[:, frame] = frame_color[:, None]

    def pixels(image: np.ndarray) -> np.ndarray:
        image = gaussian_filter(image, look.blur_m / step)
        return image.reshape(shape[0] // FINER, FINER, shape[1] // FINER, FINER).mean(axis=(1, 3))

    celsius = pixels(celsius)
    drift = look.drift_c * np.linspace(0, 1, celsius.shape[1])
    celsius = celsius + drift + rng.normal(0, look.noise_c, celsius.shape)
    colors = np.stack([pixels(each) for each in colors]) + rng.normal(0, 3, (3, *celsius.shape))
    middle = slice(FINER // 2, None, FINER)
    height = height[middle, middle] + rng.normal(0, 0.02, celsius.shape)
    x = low[0] + pixel_m * (np.arange(celsius.shape[1]) + 0.5)
    y = low[1] + pixel_m * (celsius.shape[0] - np.arange(celsius.shape[0]) - 0.5)
    points = np.concatenate([np.stack(np.meshgrid(x, y), axis=-1), height[..., None]], axis=2)
    return PlantMap(*(each.astype(np.float32) for each in (celsius, colors, points)), pixel_m)
