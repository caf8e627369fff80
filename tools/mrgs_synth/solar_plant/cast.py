"""Photos of a solar plant by ray casting: one ray to the first surface, and one from there to the
sun.

Surfaces are matt, but that glass also reflects an even sky; in the infrared all are black bodies,
so that each has one exact temperature.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numba import njit

from mrgs.scene import Camera
from mrgs_synth.planck import band_radiance, temperature
from mrgs_synth.solar_plant.ground import STEP_M, TILE_M
from mrgs_synth.solar_plant.layout import (
    AIR_C,
    CELLS,
    CLEARANCE_M,
    FRAME_M,
    MODULE_M,
    SOUND_C,
    TABLE_MODULES,
    Plant,
)

RAYS_PER_SIDE = 4
"""Of the rays of a pixel."""

SUN = (-0.32, -0.55, 0.771)
"""Unit vector towards it."""

SUNLIGHT, SKYLIGHT, SKY = 1.0, 0.35, 0.55
"""Irradiances of surfaces, and what glass reflects."""

LUSH, DRY = (0.05, 0.11, 0.03), (0.34, 0.29, 0.17)
"""Linear colours of the ground."""

CELL, FRAME, WIRE = (0.012, 0.022, 0.06), (0.55, 0.56, 0.58), (0.16, 0.17, 0.2)
WIRES, WIRE_M = 3, 0.006
"""Bright wires on each cell, and the gap between cells."""

GROUND_C, LUSH_C, PATTERN_C, SHADE_C = 36.0, -6.0, 5.0, -8.0
"""Temperature of dry ground in the sun, and what grass, its pattern and shade add."""

FRAME_COOLER_C = 4.0
BIN_M = 2.0
REACH_M = CLEARANCE_M + 1.6
"""No table stands higher above the ground below it."""

SUN_M = 2.0 * REACH_M / SUN[2]
"""Farther away nothing stands between a point and the sun."""

ITERATIONS = 7
"""Towards the point where a ray meets the ground; each is about ten times as exact as the last."""

SAME_M = 0.05
"""Points closer than this are the same surface."""

compiled = njit(cache=True, nogil=True)


class Surfaces(NamedTuple):
    """What rays meet, as few plain arrays for the compiler; see ``Ground`` and ``Tables``.

    Attributes:
        low: x and y of the first point of the ground's grid.
        grid: height and lushness of the ground, [R, C, 2].
        pattern: of the ground.
        planes: corner, along, up, normal, width and height of each table, [T, 14].
        tone: of the modules.
        cell_c: of the cells, °C.
        starts: where the tables over each square of ``BIN_M`` begin in ``items``, rows along y, and
            where they end, [Y, X, 2].
        items: their numbers.
    """

    low: np.ndarray
    grid: np.ndarray
    pattern: np.ndarray
    planes: np.ndarray
    tone: np.ndarray
    cell_c: np.ndarray
    starts: np.ndarray
    items: np.ndarray


class Photo(NamedTuple):
    """What one camera sees: the photo, the exact temperatures in °C (of the pixels' mean radiance),
    and the z-depth at their centres in metres."""

    rgb: UInt8[np.ndarray, "h w 3"]
    exact_c: Float[np.ndarray, "h w"]
    depth_m: Float[np.ndarray, "h w"]


def surfaces_of(plant: Plant) -> Surfaces:
    """The plant as the ray caster needs it."""
    ground, tables = plant.ground, plant.tables
    width = tables.modules * MODULE_M[0]
    size = np.stack([width, np.full_like(width, TABLE_MODULES[1] * MODULE_M[1])], axis=1)
    normal = np.cross(tables.along, tables.up)
    planes = np.concatenate([tables.corner, tables.along, tables.up, normal, size], axis=1)
    starts, items = _tables_by_square(plant, size)
    return Surfaces(
        np.array(ground.low),
        np.stack([ground.heights, ground.patches], axis=2),
        ground.pattern.astype(np.float32),
        planes, tables.tone, tables.cell_c, starts, items,
    )  # fmt: skip


def _tables_by_square(
    plant: Plant, size: Float[np.ndarray, "t 2"]
) -> tuple[Int[np.ndarray, "y x 2"], Int[np.ndarray, " n"]]:
    ground, tables = plant.ground, plant.tables
    far = tables.corner + size[:, :1] * tables.along + size[:, 1:] * tables.up
    low = np.array(ground.low)
    rows, columns = (int(np.ceil(n * STEP_M / BIN_M)) for n in ground.heights.shape)
    first, last = (
        ((place[:, :2] - low) // BIN_M).astype(np.int64) for place in (tables.corner, far)
    )
    lists: list[list[int]] = [[] for _ in range(rows * columns)]
    for table, ((left, bottom), (right, top)) in enumerate(zip(first, last, strict=True)):
        for row in range(bottom, top + 1):
            for column in range(left, right + 1):
                lists[row * columns + column].append(table)
    ends = np.cumsum([len(each) for each in lists])
    starts = np.stack([np.concatenate([[0], ends[:-1]]), ends], axis=1).reshape(rows, columns, 2)
    return starts, np.array([table for each in lists for table in each], np.int64)


def photograph(surfaces: Surfaces, camera: Camera) -> Photo:
    """Photograph the plant in colour and in the infrared; the camera looks down."""
    height, width = camera.height, camera.width
    linear, radiance = np.zeros((height, width, 3)), np.zeros((height, width))
    celsius = np.zeros((height, width))
    K, viewmat = camera.K.numpy(), camera.viewmat.numpy()
    position = camera.position.numpy()
    for part in range(RAYS_PER_SIDE**2):
        offset = (np.array(divmod(part, RAYS_PER_SIDE)) + 0.5) / RAYS_PER_SIDE
        _add_rays(surfaces, K, viewmat[:3, :3], position, offset, linear, celsius)
        radiance += band_radiance(celsius)
    rays = RAYS_PER_SIDE**2
    rgb = np.round(255.0 * _srgb((linear / rays).clip(0.0, 1.0))).astype(np.uint8)
    depth_m = _depths(surfaces, K, viewmat[:3, :3], position, height, width)
    return Photo(rgb, temperature(radiance / rays), depth_m)


def seen_from(
    surfaces: Surfaces, position: Float[np.ndarray, "3"], points: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Which points of the surfaces nothing hides from a place above."""
    return _seen(surfaces, position, points)


def warmest_and_coldest(plant: Plant) -> tuple[float, float]:
    """Bounds of all temperatures that a photo may show, °C."""
    coldest = min(GROUND_C + LUSH_C + SHADE_C, float(plant.tables.cell_c.min()) - FRAME_COOLER_C)
    return min(coldest, AIR_C), max(float(plant.tables.cell_c.max()), GROUND_C + PATTERN_C)


def _srgb(linear: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    low = 12.92 * linear
    return np.where(linear <= 0.0031308, low, 1.055 * linear ** (1 / 2.4) - 0.055)


@compiled
@no_type_check
def _add_rays(surfaces, K, rotation, position, offset, linear, celsius):
    """Cast one ray of each pixel, at ``offset`` (row, column) in it: add its colour, and write what
    is seen there, °C."""
    low, grid, pattern, planes, tone, cell_c, starts, items = surfaces
    for row in range(linear.shape[0]):
        for column in range(linear.shape[1]):
            ray = _direction(K, rotation, row + offset[0], column + offset[1])
            table, point = _first_surface(low, grid, planes, starts, items, position, ray)
            lit = _nearest_table(low, planes, starts, items, point, SUN, 1e-3, SUN_M)[0] < 0
            if table < 0:
                warmth, r, g, b = _of_ground(low, grid, pattern, point, lit)
            else:
                warmth, r, g, b = _of_table(
                    planes[table], tone[table], cell_c[table], point, ray, lit
                )
            celsius[row, column] = warmth
            linear[row, column, 0] += r
            linear[row, column, 1] += g
            linear[row, column, 2] += b


@compiled
@no_type_check
def _depths(surfaces, K, rotation, position, height, width):
    low, grid, _, planes, _, _, starts, items = surfaces
    depth = np.empty((height, width))
    for row in range(height):
        for column in range(width):
            ray = _direction(K, rotation, row + 0.5, column + 0.5)
            _, point = _first_surface(low, grid, planes, starts, items, position, ray)
            depth[row, column] = (
                rotation[2, 0] * (point[0] - position[0])
                + rotation[2, 1] * (point[1] - position[1])
                + rotation[2, 2] * (point[2] - position[2])
            )
    return depth


@compiled
@no_type_check
def _seen(surfaces, position, points):
    low, grid, _, planes, _, _, starts, items = surfaces
    seen = np.empty(len(points), np.bool_)
    for n in range(len(points)):
        ray = (
            points[n, 0] - position[0], points[n, 1] - position[1], points[n, 2] - position[2],
        )  # fmt: skip
        _, met = _first_surface(low, grid, planes, starts, items, position, ray)
        away = max(abs(met[0] - points[n, 0]), abs(met[1] - points[n, 1]))
        seen[n] = max(away, abs(met[2] - points[n, 2])) < SAME_M
    return seen


@compiled
@no_type_check
def _direction(K, rotation, row, column):
    """The ray (z-depth 1) through a place in the image, in the world."""
    x, y = (column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1]
    return (
        x * rotation[0, 0] + y * rotation[1, 0] + rotation[2, 0],
        x * rotation[0, 1] + y * rotation[1, 1] + rotation[2, 1],
        x * rotation[0, 2] + y * rotation[1, 2] + rotation[2, 2],
    )


@compiled
@no_type_check
def _bilinear(low, grid, which, x, y):
    """A value of the ground's grid."""
    column = min(max((x - low[0]) / STEP_M, 0.0), grid.shape[1] - 1.000001)
    row = min(max((y - low[1]) / STEP_M, 0.0), grid.shape[0] - 1.000001)
    j, i = int(column), int(row)
    s, t = column - j, row - i
    return (1 - t) * ((1 - s) * grid[i, j, which] + s * grid[i, j + 1, which]) + t * (
        (1 - s) * grid[i + 1, j, which] + s * grid[i + 1, j + 1, which]
    )


@compiled
@no_type_check
def _first_surface(low, grid, planes, starts, items, origin, ray):
    """Where a ray that goes down first meets a surface: the table, or −1 for the ground, and the
    point."""
    z = 0.0
    for _ in range(ITERATIONS):
        far = (z - origin[2]) / ray[2]
        z = _bilinear(low, grid, 0, origin[0] + far * ray[0], origin[1] + far * ray[1])
    far = (z - origin[2]) / ray[2]
    # Tables stand below the ray's last metres, over ground that may be higher by a little.
    near = max(far + 2.0 * REACH_M / ray[2], 0.0)
    table, far = _nearest_table(low, planes, starts, items, origin, ray, near, far)
    point = (origin[0] + far * ray[0], origin[1] + far * ray[1], origin[2] + far * ray[2])
    return table, point


@compiled
@no_type_check
def _nearest_table(low, planes, starts, items, origin, ray, near, far):
    """The first table that a ray meets between two distances, and where; −1 and ``far`` if none."""
    found = -1
    x0, x1 = origin[0] + near * ray[0] - low[0], origin[0] + far * ray[0] - low[0]
    y0, y1 = origin[1] + near * ray[1] - low[1], origin[1] + far * ray[1] - low[1]
    left, right = max(int(min(x0, x1) / BIN_M), 0), int(max(x0, x1) / BIN_M)
    bottom, top = max(int(min(y0, y1) / BIN_M), 0), int(max(y0, y1) / BIN_M)
    for row in range(bottom, min(top, starts.shape[0] - 1) + 1):
        for column in range(left, min(right, starts.shape[1] - 1) + 1):
            for item in range(starts[row, column, 0], starts[row, column, 1]):
                distance = _meets(planes, items[item], origin, ray)
                if near < distance < far:
                    found, far = items[item], distance
    return found, far


@compiled
@no_type_check
def _meets(planes, table, origin, ray):
    """The distance at which a ray meets a table; −1 if it does not."""
    x, y, z = (
        planes[table, 0] - origin[0], planes[table, 1] - origin[1], planes[table, 2] - origin[2],
    )  # fmt: skip
    against = planes[table, 9] * ray[0] + planes[table, 10] * ray[1] + planes[table, 11] * ray[2]
    if abs(against) < 1e-9:
        return -1.0
    distance = (planes[table, 9] * x + planes[table, 10] * y + planes[table, 11] * z) / against
    x, y, z = distance * ray[0] - x, distance * ray[1] - y, distance * ray[2] - z
    u = x * planes[table, 3] + y * planes[table, 4] + z * planes[table, 5]
    v = x * planes[table, 6] + y * planes[table, 7] + z * planes[table, 8]
    inside = 0.0 <= u <= planes[table, 12] and 0.0 <= v <= planes[table, 13]
    return distance if inside else -1.0


@compiled
@no_type_check
def _of_ground(low, grid, pattern, point, lit):
    """The temperature of the ground, °C; its colour."""
    size = pattern.shape[0]
    i = int(np.floor(point[1] / TILE_M * size)) % size
    j = int(np.floor(point[0] / TILE_M * size)) % size
    lush = _bilinear(low, grid, 1, point[0], point[1])
    light = (SKYLIGHT + SUNLIGHT * SUN[2] * lit) * (0.4 + 1.2 * pattern[i, j])
    celsius = GROUND_C + LUSH_C * lush + PATTERN_C * pattern[i, j] + (0.0 if lit else SHADE_C)
    return (
        celsius,
        (lush * LUSH[0] + (1.0 - lush) * DRY[0]) * light,
        (lush * LUSH[1] + (1.0 - lush) * DRY[1]) * light,
        (lush * LUSH[2] + (1.0 - lush) * DRY[2]) * light,
    )


@compiled
@no_type_check
def _of_table(plane, tone, cell_c, point, ray, lit):
    """The temperature of a table's front, °C; its colour."""
    x, y, z = point[0] - plane[0], point[1] - plane[1], point[2] - plane[2]
    u = x * plane[3] + y * plane[4] + z * plane[5]
    v = x * plane[6] + y * plane[7] + z * plane[8]
    column = min(int(u / MODULE_M[0]), TABLE_MODULES[0] - 1)
    above = min(int(v / MODULE_M[1]), TABLE_MODULES[1] - 1)
    x, y = u - column * MODULE_M[0] - FRAME_M, v - above * MODULE_M[1] - FRAME_M
    across, along = (MODULE_M[0] - 2 * FRAME_M) / CELLS[0], (MODULE_M[1] - 2 * FRAME_M) / CELLS[1]
    light = SKYLIGHT + SUNLIGHT * lit * max(
        SUN[0] * plane[9] + SUN[1] * plane[10] + SUN[2] * plane[11], 0.0
    )
    i, j = int(np.floor(y / along)), int(np.floor(x / across))
    if not (0 <= i < CELLS[1] and 0 <= j < CELLS[0]):
        # A frame conducts: it is cooler than the module, and shows no hot cell.
        return SOUND_C - FRAME_COOLER_C, FRAME[0] * light, FRAME[1] * light, FRAME[2] * light
    wire = _distance_to_wires(x - j * across, across, y - i * along, along) < WIRE_M / 2
    slant = abs(plane[9] * ray[0] + plane[10] * ray[1] + plane[11] * ray[2])
    slant /= np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
    mirrored = (0.04 + 0.96 * (1.0 - slant) ** 5) * SKY
    light *= tone[above, column]
    return (
        cell_c[above * CELLS[1] + i, column * CELLS[0] + j],
        (WIRE[0] if wire else CELL[0]) * light + mirrored,
        (WIRE[1] if wire else CELL[1]) * light + mirrored,
        (WIRE[2] if wire else CELL[2]) * light + mirrored,
    )


@compiled
@no_type_check
def _distance_to_wires(x, width, y, height):
    """From a place in a cell to the nearest wire or gap."""
    nearest = min(x, width - x, y, height - y)
    for wire in range(WIRES):
        nearest = min(nearest, abs(x - (wire + 0.5) / WIRES * width))
    return nearest
