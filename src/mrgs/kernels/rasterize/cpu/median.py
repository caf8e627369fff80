"""Median depth of a layer: the walk of ``blend``, until the surface is passed."""

from __future__ import annotations

import numpy as np
from numba import prange

from mrgs.kernels.jit import strict_inlined_function, strict_inner_function, strict_parallel_kernel
from mrgs.kernels.rasterize.cpu.blend import (
    ALL_VECTORS,
    HALF,
    ONE,
    TILE_PIXELS,
    TRANSMITTANCE,
    VECTOR_ROWS,
    ZERO,
    contribution,
    interleaved,
    log2_gaussian,
    offset_across,
    open_transmittance,
    vector_range,
)
from mrgs.kernels.rasterize.cpu.simd import (
    LANES,
    any_lane,
    broadcast,
    exp2,
    lane_columns,
    lane_rows,
    load,
    minimum,
    pointer,
    prefetch,
    read,
    select,
    stack_floats,
    store,
)
from mrgs.kernels.rasterize.cpu.tiles import PREFETCH_AHEAD, TILE_HEIGHT, TILE_WIDTH
from mrgs.rasterizer import contract, splat

NAN = np.float32(np.nan)
LEAST_NEARNESS = np.float32(1 / contract.STEEPEST)
SURFACE_BEGINS, SURFACE_ENDS = (np.float32(share) for share in contract.SURFACE_TRANSMITTANCES)

SLOPE_X = splat.COLOR + 1
SLOPE_Y = splat.COLOR + 2
"""∂z/∂x' / z of a splat, where a record has the features of its first layer."""

_SHARES = TILE_PIXELS
_SHARED_DEPTHS = 2 * TILE_PIXELS
_TILE_FLOATS = 3 * TILE_PIXELS
"""Behind a tile's plane of T stand the sums of w and of w z over the splats of the surface, w being
a splat's share of it."""


@strict_inlined_function()
def _pass_surface(planes, at, splats, record, gaussian, dx, dy):
    """Let a splat take its share of T in a vector of pixels, and of the surface; whether that goes
    on behind it anywhere."""
    begins, ends = broadcast(SURFACE_BEGINS), broadcast(SURFACE_ENDS)
    ahead = load(planes, at + TRANSMITTANCE)
    _, _, _, _, behind = contribution(planes, at, splats, record, splat.COLOR, gaussian)
    centre, zero = broadcast(read(splats, record + splat.DEPTH)), broadcast(ZERO)
    nearness = broadcast(ONE)
    nearness = nearness - broadcast(read(splats, record + SLOPE_X)) * dx
    nearness = nearness - broadcast(read(splats, record + SLOPE_Y)) * dy
    least = broadcast(LEAST_NEARNESS)
    depth = centre / select(least < nearness, nearness, least)
    share = minimum(ahead, begins) - select(ends < behind, behind, ends)
    share = select(zero < share, share, zero)
    store(planes, at + _SHARES, load(planes, at + _SHARES) + share)
    store(planes, at + _SHARED_DEPTHS, load(planes, at + _SHARED_DEPTHS) + share * depth)
    return any_lane(ends < behind)


@strict_inner_function()
def _median(planes, pixel):
    """The depth of the surface at a pixel; NaN where more than half of the light passes."""
    if read(planes, pixel + TRANSMITTANCE) > HALF:
        return NAN
    return read(planes, pixel + _SHARED_DEPTHS) / read(planes, pixel + _SHARES)


@strict_inner_function()
def _walk_tile(planes, splats, tile_splats, first, last, x0, y0):
    """The walk of ``blend._blend_tile`` again; left when every pixel is behind its surface."""
    centres_x = lane_columns(TILE_WIDTH) + broadcast(np.float32(x0 + 0.5))
    centres_y = lane_rows(TILE_WIDTH) + broadcast(np.float32(y0 + 0.5))
    live_vectors = ALL_VECTORS
    for position in range(first, last):
        record = tile_splats[position] * splat.SPLAT_FLOATS
        prefetch(splats, tile_splats[min(position + PREFETCH_AHEAD, last - 1)] * splat.SPLAT_FLOATS)
        dx = centres_x - broadcast(read(splats, record + splat.MEAN_X))
        first_dy = centres_y - broadcast(read(splats, record + splat.MEAN_Y))
        threshold = broadcast(read(splats, record + splat.THRESHOLD))
        first_vector, last_vector = vector_range(splats, record, y0)
        for vector in range(first_vector, last_vector + 1):
            if not (live_vectors >> vector) & 1:
                continue
            dy = first_dy + broadcast(np.float32(vector * VECTOR_ROWS))
            across = offset_across(splats, record, dx, dy)
            exponent = log2_gaussian(splats, record, across, dy)
            if not any_lane(exponent >= threshold):
                continue
            gaussian = exp2(exponent)
            if not _pass_surface(planes, vector * LANES, splats, record, gaussian, dx, dy):
                live_vectors &= ~(1 << vector)
        if live_vectors == 0:
            break


@strict_parallel_kernel()
def median(splats, tile_splats, tile_starts, depth):
    """Fill the median depth [H, W] of the first layer, whose opacities stand in ``splat.COLOR``.

    Args:
        splats: records in depth order, [V, 16].
        tile_splats, tile_starts: the tiles' lists.
        depth: NaN where more than half of the light passes all splats.
    """
    height, width = depth.shape
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    tiles = tile_starts.size - 1
    for index in prange(tiles):
        tile = interleaved(index, tiles)
        x0, y0 = tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT
        planes = stack_floats(_TILE_FLOATS)
        open_transmittance(planes, 0, x0, y0, width, height)
        _walk_tile(
            planes, pointer(splats), tile_splats, tile_starts[tile], tile_starts[tile + 1], x0, y0
        )
        for row in range(min(TILE_HEIGHT, height - y0)):
            for column in range(min(TILE_WIDTH, width - x0)):
                depth[y0 + row, x0 + column] = _median(planes, row * TILE_WIDTH + column)
