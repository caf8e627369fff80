"""Alpha blending of the tiles: both layers in one walk, front to back, eight pixels at a time.

    α_i = min(0.999, o_i G_i),  w_i = α_i T_i,  image = Σ w_i f_i + T_end · background,  depth = Σ w_i z_i

A tile keeps its pixels as planes of floats (``_TRANSMITTANCE_RGB``, ...), each row of the tile being one vector.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from mrgs.rasterizer import contract
from mrgs.rasterizer.cpu import splat
from mrgs.rasterizer.cpu.jit import kernel, parallel_kernel
from mrgs.rasterizer.cpu.simd import any_lane, exp2, lane_indices, load, minimum, select, store
from mrgs.rasterizer.cpu.simd import splat as spread
from mrgs.rasterizer.cpu.tiles import TILE_HEIGHT, TILE_WIDTH

ALPHA_MAX = np.float32(contract.ALPHA_MAX)
ALPHA_MIN = np.float32(contract.ALPHA_MIN)
TRANSMITTANCE_MIN = np.float32(contract.TRANSMITTANCE_MIN)

TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
ALL_ROWS = (1 << TILE_HEIGHT) - 1
TILE_STRIDE = 7
"""Neighbouring tiles cost alike: the threads' shares are interleaved by walking the tiles in steps of about 1/7."""

# Offsets of a tile's planes.
TRANSMITTANCE_RGB = 0 * TILE_PIXELS
TRANSMITTANCE_THERMAL = 1 * TILE_PIXELS
_RED = 2 * TILE_PIXELS
_GREEN = 3 * TILE_PIXELS
_BLUE = 4 * TILE_PIXELS
_DEPTH_RGB = 5 * TILE_PIXELS
_TEMPERATURE = 6 * TILE_PIXELS
_DEPTH_THERMAL = 7 * TILE_PIXELS
_PLANES = 8

# Channels of the images [H, W, 8] that the walk writes.
IMAGE_CHANNELS = 8
IMAGE_RGB = slice(0, 3)
IMAGE_TEMPERATURE = slice(3, 4)
IMAGE_DEPTH_RGB = 4
IMAGE_DEPTH_THERMAL = 5
IMAGE_ALPHA_RGB = 6
IMAGE_ALPHA_THERMAL = 7


@kernel()
def interleaved(index, tiles):
    """A permutation of the tiles that spreads neighbours over the threads."""
    step = tiles // TILE_STRIDE + 1
    while math.gcd(step, tiles) != 1:
        step += 1
    return index * step % tiles


@kernel()
def open_transmittance(planes, x0, y0, width, height):
    """T = 1 on the pixels of the image, 0 on those of the tile that lie outside: they never blend."""
    for row in range(TILE_HEIGHT):
        for column in range(TILE_WIDTH):
            inside = np.float32(1.0 if x0 + column < width and y0 + row < height else 0.0)
            planes[TRANSMITTANCE_RGB + row * TILE_WIDTH + column] = inside
            planes[TRANSMITTANCE_THERMAL + row * TILE_WIDTH + column] = inside


@kernel()
def row_range(record, y0):
    """First and last row of the tile whose pixel centres the splat's ellipse can reach."""
    first = math.ceil(record[splat.MEAN_Y] - record[splat.EXTENT_Y] - 0.5) - y0
    last = math.floor(record[splat.MEAN_Y] + record[splat.EXTENT_Y] - 0.5) - y0
    return max(int(first), 0), min(int(last), TILE_HEIGHT - 1)


@kernel()
def _blend_tile(planes, splats, tile_splats, first, last, x0, y0):
    """Walk the tile's list front to back; leave when no pixel of either layer lets light through."""
    one_over_255 = spread(ALPHA_MIN)
    alpha_max = spread(ALPHA_MAX)
    nearly_opaque = spread(TRANSMITTANCE_MIN)
    zero = spread(np.float32(0.0))
    centres_x = lane_indices() + spread(np.float32(x0 + 0.5))
    live_rows = ALL_ROWS
    for position in range(first, last):
        record = splats[tile_splats[position]]
        dx = centres_x - spread(record[splat.MEAN_X])
        quadratic = spread(record[splat.CONIC_XX]) * dx
        threshold = spread(record[splat.THRESHOLD])
        first_row, last_row = row_range(record, y0)
        for row in range(first_row, last_row + 1):
            if not (live_rows >> row) & 1:
                continue
            dy = np.float32(y0 + row + 0.5) - record[splat.MEAN_Y]
            linear = spread(record[splat.CONIC_XY] * dy)
            log2_gaussian = (quadratic + linear) * dx + spread(record[splat.CONIC_YY] * dy * dy)
            if not any_lane(log2_gaussian >= threshold):
                continue
            gaussian = exp2(log2_gaussian)
            at = row * TILE_WIDTH
            transmittance_rgb = load(planes, TRANSMITTANCE_RGB + at)
            transmittance_thermal = load(planes, TRANSMITTANCE_THERMAL + at)

            alpha = minimum(spread(record[splat.OPACITY_RGB]) * gaussian, alpha_max)
            blends = (alpha >= one_over_255) & (transmittance_rgb >= nearly_opaque)
            if any_lane(blends):
                weight = select(blends, alpha * transmittance_rgb, zero)
                transmittance_rgb = transmittance_rgb - weight
                store(planes, TRANSMITTANCE_RGB + at, transmittance_rgb)
                store(planes, _RED + at, load(planes, _RED + at) + weight * spread(record[splat.RED]))
                store(planes, _GREEN + at, load(planes, _GREEN + at) + weight * spread(record[splat.GREEN]))
                store(planes, _BLUE + at, load(planes, _BLUE + at) + weight * spread(record[splat.BLUE]))
                store(planes, _DEPTH_RGB + at, load(planes, _DEPTH_RGB + at) + weight * spread(record[splat.DEPTH]))

            alpha = minimum(spread(record[splat.OPACITY_THERMAL]) * gaussian, alpha_max)
            blends = (alpha >= one_over_255) & (transmittance_thermal >= nearly_opaque)
            if any_lane(blends):
                weight = select(blends, alpha * transmittance_thermal, zero)
                transmittance_thermal = transmittance_thermal - weight
                store(planes, TRANSMITTANCE_THERMAL + at, transmittance_thermal)
                temperature = load(planes, _TEMPERATURE + at) + weight * spread(record[splat.TEMPERATURE])
                store(planes, _TEMPERATURE + at, temperature)
                depth = load(planes, _DEPTH_THERMAL + at) + weight * spread(record[splat.DEPTH])
                store(planes, _DEPTH_THERMAL + at, depth)

            if not any_lane((transmittance_rgb >= nearly_opaque) | (transmittance_thermal >= nearly_opaque)):
                live_rows &= ~(1 << row)
        if live_rows == 0:
            break


@kernel()
def _write_tile(planes, backgrounds, x0, y0, image):
    """Planes -> pixels of the image, over the backgrounds (red, green, blue, temperature)."""
    for row in range(min(TILE_HEIGHT, image.shape[0] - y0)):
        for column in range(min(TILE_WIDTH, image.shape[1] - x0)):
            at = row * TILE_WIDTH + column
            pixel = image[y0 + row, x0 + column]
            transmittance_rgb = planes[TRANSMITTANCE_RGB + at]
            transmittance_thermal = planes[TRANSMITTANCE_THERMAL + at]
            pixel[0] = planes[_RED + at] + transmittance_rgb * backgrounds[0]
            pixel[1] = planes[_GREEN + at] + transmittance_rgb * backgrounds[1]
            pixel[2] = planes[_BLUE + at] + transmittance_rgb * backgrounds[2]
            pixel[3] = planes[_TEMPERATURE + at] + transmittance_thermal * backgrounds[3]
            pixel[IMAGE_DEPTH_RGB] = planes[_DEPTH_RGB + at]
            pixel[IMAGE_DEPTH_THERMAL] = planes[_DEPTH_THERMAL + at]
            pixel[IMAGE_ALPHA_RGB] = np.float32(1.0) - transmittance_rgb
            pixel[IMAGE_ALPHA_THERMAL] = np.float32(1.0) - transmittance_thermal


@parallel_kernel()
def blend(splats, tile_splats, tile_starts, backgrounds, image):
    """Fill ``image`` [H, W, 8]: red, green, blue, temperature, both depths, both alphas.

    Args:
        splats: records in depth order, [V, 16].
        tile_splats, tile_starts: the tiles' lists.
        backgrounds: red, green, blue, temperature, [4].
    """
    height, width = image.shape[0], image.shape[1]
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    tiles = tile_starts.size - 1
    for index in prange(tiles):
        tile = interleaved(index, tiles)
        x0, y0 = tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT
        planes = np.zeros(_PLANES * TILE_PIXELS, np.float32)
        open_transmittance(planes, x0, y0, width, height)
        _blend_tile(planes, splats, tile_splats, tile_starts[tile], tile_starts[tile + 1], x0, y0)
        _write_tile(planes, backgrounds, x0, y0, image)
