"""Alpha blending of the tiles: both layers in one walk, front to back, sixteen pixels at a time.

    α_i = min(0.999, o_i G_i),  w_i = α_i T_i,
    image = Σ w_i f_i + T_end · background,  depth = Σ w_i z_i

A tile keeps its pixels as planes of floats, two rows of the tile being one vector. A layer's planes
stand one after the other: transmittance T, depth, then its channels.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from mrgs.kernels.jit import strict_inlined_function, strict_inner_function, strict_parallel_kernel
from mrgs.kernels.rasterize.cpu.simd import (
    LANES,
    any_lane,
    broadcast,
    ceil_to_int,
    exp2,
    floor_to_int,
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
    write,
)
from mrgs.kernels.rasterize.cpu.tiles import PREFETCH_AHEAD, TILE_HEIGHT, TILE_WIDTH
from mrgs.rasterizer import contract, splat

ALPHA_MAX = np.float32(contract.ALPHA_MAX)
ALPHA_MIN = np.float32(contract.ALPHA_MIN)
TRANSMITTANCE_MIN = np.float32(contract.TRANSMITTANCE_MIN)
ZERO = np.float32(0.0)
HALF = np.float32(0.5)
ONE = np.float32(1.0)

TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
VECTOR_ROWS = LANES // TILE_WIDTH
"""Rows of the tile in one vector."""

ALL_VECTORS = (1 << (TILE_HEIGHT // VECTOR_ROWS)) - 1
TILE_STRIDE = 7
"""Neighbouring tiles cost alike: the threads' shares are interleaved by walking the tiles in steps
of about 1/7."""

TRANSMITTANCE = 0
DEPTH = TILE_PIXELS
FEATURES = 2 * TILE_PIXELS
"""Offsets of the planes within a layer."""

_COLOR = 0
_SCALAR = 5 * TILE_PIXELS
TILE_FLOATS = 8 * TILE_PIXELS
"""Offsets of the layers within a tile, and the size of all."""


@strict_inner_function()
def interleaved(index, tiles):
    """A permutation of the tiles that spreads neighbours over the threads."""
    step = tiles // TILE_STRIDE + 1
    while math.gcd(step, tiles) != 1:
        step += 1
    return index * step % tiles


@strict_inner_function()
def open_transmittance(planes, layer, x0, y0, width, height):
    """T = 1 on the pixels of the image, 0 on those of the tile that lie outside: they never
    blend."""
    for row in range(min(TILE_HEIGHT, height - y0)):
        for column in range(min(TILE_WIDTH, width - x0)):
            write(planes, layer + TRANSMITTANCE + row * TILE_WIDTH + column, ONE)


@strict_inlined_function()
def vector_range(splats, record, y0):
    """First and last vector of the tile whose rows of pixel centres the splat's ellipse can
    reach."""
    mean_y, extent_y = read(splats, record + splat.MEAN_Y), read(splats, record + splat.EXTENT_Y)
    first = ceil_to_int(mean_y - extent_y - HALF) - y0
    last = floor_to_int(mean_y + extent_y - HALF) - y0
    return max(first, 0) // VECTOR_ROWS, min(last, TILE_HEIGHT - 1) // VECTOR_ROWS


@strict_inlined_function()
def offset_across(splats, record, dx, dy):
    """dx from the midline of a splat's ellipse, at sixteen pixels."""
    return dx - broadcast(read(splats, record + splat.SHEAR)) * dy


@strict_inlined_function()
def log2_gaussian(splats, record, across, dy):
    """log2 of the projected Gaussian G' at sixteen pixels."""
    along = broadcast(read(splats, record + splat.ALONG)) * dy * dy
    return broadcast(read(splats, record + splat.ACROSS)) * across * across + along


@strict_inlined_function()
def contribution(planes, at, splats, record, layer, gaussian):
    """What one layer of a splat contributes to a vector of pixels; the transmittance behind it is
    stored.

    Args:
        planes, at: the tile's planes, and the offset of the vector in the layer's first plane.
        splats, record: the records, and the offset of this splat's.
        layer: the layer's part of the record.
        gaussian: G' at the pixels.

    Returns:
        o G', α = min(0.999, o G'), whether it blends, its weight α T (0 where it does not), and the
        transmittance behind it.
    """
    transmittance = load(planes, at + TRANSMITTANCE)
    unclamped = broadcast(read(splats, record + layer)) * gaussian
    alpha = minimum(unclamped, broadcast(ALPHA_MAX))
    blends = (alpha >= broadcast(ALPHA_MIN)) & (transmittance >= broadcast(TRANSMITTANCE_MIN))
    weight = select(blends, alpha * transmittance, broadcast(ZERO))
    transmittance = transmittance - weight
    store(planes, at + TRANSMITTANCE, transmittance)
    return unclamped, alpha, blends, weight, transmittance


@strict_inlined_function()
def _accumulate(planes, at, weight, value):
    store(planes, at, load(planes, at) + weight * broadcast(value))


@strict_inlined_function()
def _blend_layer(planes, at, splats, record, layer, channels, gaussian):
    """Blend one layer of a splat into a vector of pixels; their transmittance behind it.

    Nothing is skipped where no pixel blends: a branch would be mispredicted more often than it
    saves work.

    Args:
        planes, at: the tile's planes, and the offset of the vector in the layer's first plane.
        splats, record: the records, and the offset of this splat's.
        layer: the layer's part of the record.
        channels: 3 or 1.
        gaussian: G' at the pixels.
    """
    _, _, _, weight, transmittance = contribution(planes, at, splats, record, layer, gaussian)
    _accumulate(planes, at + DEPTH, weight, read(splats, record + splat.DEPTH))
    for channel in range(channels):
        feature = read(splats, record + layer + 1 + channel)
        _accumulate(planes, at + FEATURES + channel * TILE_PIXELS, weight, feature)
    return transmittance


@strict_inner_function()
def _blend_tile(planes, splats, tile_splats, first, last, x0, y0):
    """Walk the tile's list front to back; leave when no pixel of either layer lets light
    through."""
    nearly_opaque = broadcast(TRANSMITTANCE_MIN)
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
            at = vector * LANES
            behind_color = _blend_layer(
                planes, _COLOR + at, splats, record, splat.COLOR, 3, gaussian
            )
            behind_scalar = _blend_layer(
                planes, _SCALAR + at, splats, record, splat.SCALAR, 1, gaussian
            )
            if not any_lane((behind_color >= nearly_opaque) | (behind_scalar >= nearly_opaque)):
                live_vectors &= ~(1 << vector)
        if live_vectors == 0:
            break


@strict_inner_function()
def _write_layer(
    planes, layer, channels, background, x0, y0, width, height, image, depth, transmittances
):
    """A layer's planes -> pixels of its images, over the background."""
    for row in range(min(TILE_HEIGHT, height - y0)):
        for column in range(min(TILE_WIDTH, width - x0)):
            at = layer + row * TILE_WIDTH + column
            pixel = (y0 + row) * width + x0 + column
            transmittance = read(planes, at + TRANSMITTANCE)
            for channel in range(channels):
                feature = read(planes, at + FEATURES + channel * TILE_PIXELS)
                write(
                    image,
                    pixel * channels + channel,
                    feature + transmittance * read(background, channel),
                )
            write(depth, pixel, read(planes, at + DEPTH))
            write(transmittances, pixel, transmittance)


@strict_parallel_kernel()
def blend(
    splats, tile_splats, tile_starts, background_color, background_scalar, color, depth_color,
    transmittance_color,
    scalar, depth_scalar, transmittance_scalar,
):  # fmt: skip
    """Fill the images of both layers: color [H, W, 3] and scalar [H, W, 1], their depths and T_end
    [H, W].

    Args:
        splats: records in depth order, [V, 16].
        tile_splats, tile_starts: the tiles' lists.
        background_color, background_scalar: [3] and [1].
    """
    height, width = transmittance_color.shape
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    tiles = tile_starts.size - 1
    for index in prange(tiles):
        tile = interleaved(index, tiles)
        x0, y0 = tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT
        planes = stack_floats(TILE_FLOATS)
        open_transmittance(planes, _COLOR, x0, y0, width, height)
        open_transmittance(planes, _SCALAR, x0, y0, width, height)
        _blend_tile(
            planes, pointer(splats), tile_splats, tile_starts[tile], tile_starts[tile + 1], x0, y0
        )
        _write_layer(
            planes, _COLOR, 3, pointer(background_color), x0, y0, width, height,
            pointer(color), pointer(depth_color), pointer(transmittance_color),
        )  # fmt: skip
        _write_layer(
            planes, _SCALAR, 1, pointer(background_scalar), x0, y0, width, height,
            pointer(scalar), pointer(depth_scalar), pointer(transmittance_scalar),
        )  # fmt: skip
