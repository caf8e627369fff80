"""Alpha blending of the tiles, its gradient, and the median depth: three walks front to back, both
layers and sixteen pixels at a time.

    α_i = min(0.999, o_i G_i),  w_i = α_i T_i,
    image = Σ w_i f_i + T_end · background,  depth = Σ w_i z_i

A tile keeps its pixels as planes of floats, two rows of the tile being one vector. A layer's planes
follow each other: transmittance T, depth, then its channels.

Backward, with g the gradient of a pixel, let R_i = Σ_{j>i} w_j (g·f_j) + T_end (g·background +
g_T): all that is behind the splat i. Then ∂L/∂α_i = T_i (g·f_i) − R_i / (1 − α_i). R starts as
g·pixel + T_end g_T and loses w_i (g·f_i) at each step; nothing is divided by T. Every (tile, splat)
pair has its own record of sums, so no atomics are needed and the result does not depend on the
number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from mrgs.kernels import simd
from mrgs.kernels.jit import (
    address,
    strict_inlined_function,
    strict_inner_function,
    strict_parallel_kernel,
)
from mrgs.kernels.rasterize.cpu.tiles import PREFETCH_AHEAD, TILE_HEIGHT, TILE_WIDTH
from mrgs.rasterizer import contract, splat

ALPHA_MAX = np.float32(contract.ALPHA_MAX)
ALPHA_MIN = np.float32(contract.ALPHA_MIN)
TRANSMITTANCE_MIN = np.float32(contract.TRANSMITTANCE_MIN)
LEAST_NEARNESS = np.float32(1 / contract.STEEPEST)
SURFACE_BEGINS, SURFACE_ENDS = (np.float32(share) for share in contract.SURFACE_TRANSMITTANCES)
ZERO, HALF, ONE, NAN = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(np.nan)

TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
VECTOR_ROWS = simd.LANES // TILE_WIDTH
"""Rows of the tile in one vector."""

ALL_VECTORS = (1 << (TILE_HEIGHT // VECTOR_ROWS)) - 1
TILE_STRIDE = 7
"""Neighbouring tiles cost alike: the threads walk them in steps of about 1/7, interleaved."""

TRANSMITTANCE = 0
DEPTH = TILE_PIXELS
FEATURES = 2 * TILE_PIXELS
"""Offsets of the planes within a layer; backward, those of the gradients of depth and features."""

_COLOR, _SCALAR, _FLOATS = 0, 5 * TILE_PIXELS, 8 * TILE_PIXELS
"""Offsets of the layers within a tile, and the size of all."""

_BEHIND_COLOR, _BEHIND_SCALAR = 5 * TILE_PIXELS, 3 * TILE_PIXELS
_BACKWARD_SCALAR, _BACKWARD_FLOATS = 6 * TILE_PIXELS, 10 * TILE_PIXELS
"""Backward, each layer has a plane of R behind the others."""

_SHARES, _SHARED_DEPTHS, _MEDIAN_FLOATS = TILE_PIXELS, 2 * TILE_PIXELS, 3 * TILE_PIXELS
"""Behind the plane of T, the median depth has the sums of w and of w z over the splats of the
surface, w being a splat's share of it."""

_SLOPE_X, _SLOPE_Y = splat.COLOR + 1, splat.COLOR + 2
"""∂z/∂x' / z of a splat, where a record has the features of its first layer."""


class LayerImages(NamedTuple):
    """The images of a layer, or their gradients: image [H, W, C], depth and T_end [H, W]."""

    image: np.ndarray
    depth: np.ndarray
    transmittance: np.ndarray


def _walk_of(start: Callable, visit: Callable, finish: Callable) -> Any:
    """A walk over a tile's list front to back, until no pixel is live; returns the position in the
    list at which it ended.

    Args:
        start: () -> sums, those of a splat before its first pixels.
        visit: (planes, at, splats, record, gaussian, offsets, sums) -> new sums, and whether any
            pixel is live behind the splat: the splat whose record begins at ``splats[record]``,
            in a vector of pixels that begins at ``planes[at]``, where the Gaussian has these
            values at the offsets dx from the centre, dx from the midline, and dy.
        finish: (out, position, sums), after the last pixels of a splat.
    """

    @strict_inner_function()
    def walk(planes, splats, tile_splats, first, last, x0, y0, out):
        centres_x = simd.lane_columns(TILE_WIDTH) + simd.broadcast(np.float32(x0 + 0.5))
        centres_y = simd.lane_rows(TILE_WIDTH) + simd.broadcast(np.float32(y0 + 0.5))
        live_vectors = ALL_VECTORS
        for position in range(first, last):
            record = tile_splats[position] * splat.SPLAT_FLOATS
            ahead = tile_splats[min(position + PREFETCH_AHEAD, last - 1)]
            simd.prefetch(splats, ahead * splat.SPLAT_FLOATS)
            sums = start()
            dx = centres_x - simd.broadcast(splats[record + splat.MEAN_X])
            first_dy = centres_y - simd.broadcast(splats[record + splat.MEAN_Y])
            threshold = simd.broadcast(splats[record + splat.THRESHOLD])
            first_vector, last_vector = _vector_range(splats, record, y0)
            for vector in range(first_vector, last_vector + 1):
                if not (live_vectors >> vector) & 1:
                    continue
                dy = first_dy + simd.broadcast(np.float32(vector * VECTOR_ROWS))
                across = dx - simd.broadcast(splats[record + splat.SHEAR]) * dy
                along = simd.broadcast(splats[record + splat.ALONG]) * dy * dy
                exponent = simd.broadcast(splats[record + splat.ACROSS]) * across * across + along
                if not simd.any_lane(exponent >= threshold):
                    continue
                offsets = dx, across, dy
                sums, is_live = visit(
                    planes, vector * simd.LANES, splats, record, simd.exp2(exponent), offsets, sums
                )
                if not is_live:
                    live_vectors &= ~(1 << vector)
            finish(out, position, sums)
            if live_vectors == 0:
                return position + 1
        return last

    return walk


@strict_inner_function()
def _tile(index, tiles, width):
    """A tile, and its first column and row. The permutation spreads neighbours over the threads."""
    step = tiles // TILE_STRIDE + 1
    while math.gcd(step, tiles) != 1:
        step += 1
    tile = index * step % tiles
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    return tile, tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT


@strict_inner_function()
def _open_transmittance(planes, layer, x0, y0, width, height):
    """T = 1 on the pixels of the image, 0 on those of the tile outside of it: they never blend."""
    for row in range(min(TILE_HEIGHT, height - y0)):
        for column in range(min(TILE_WIDTH, width - x0)):
            planes[layer + TRANSMITTANCE + row * TILE_WIDTH + column] = ONE


@strict_inlined_function()
def _vector_range(splats, record, y0):
    """First and last vector of the tile whose rows of pixel centres the ellipse can reach."""
    mean_y, extent_y = splats[record + splat.MEAN_Y], splats[record + splat.EXTENT_Y]
    first = simd.ceil_to_int(mean_y - extent_y - HALF) - y0
    last = simd.floor_to_int(mean_y + extent_y - HALF) - y0
    return max(first, 0) // VECTOR_ROWS, min(last, TILE_HEIGHT - 1) // VECTOR_ROWS


@strict_inlined_function()
def _contribution(planes, at, splats, record, layer, gaussian):
    """What one layer of a splat contributes to a vector of pixels; the transmittance behind it is
    stored.

    Nothing is skipped where no pixel blends: a branch would be mispredicted more often than it
    saves work.

    Args:
        planes, at: the tile's planes, and the offset of the vector in the layer's first plane.
        splats, record: the records, and the offset of this splat's.
        layer: the layer's part of the record.
        gaussian: G' at the pixels.

    Returns:
        o G', α = min(0.999, o G'), whether it blends, its weight α T (0 where it does not), and the
        transmittance behind it.
    """
    transmittance = simd.load(planes, at + TRANSMITTANCE)
    unclamped = simd.broadcast(splats[record + layer]) * gaussian
    alpha = simd.minimum(unclamped, simd.broadcast(ALPHA_MAX))
    blends = (alpha >= simd.broadcast(ALPHA_MIN)) & (
        transmittance >= simd.broadcast(TRANSMITTANCE_MIN)
    )
    weight = simd.select(blends, alpha * transmittance, simd.broadcast(ZERO))
    transmittance = transmittance - weight
    simd.store(planes, at + TRANSMITTANCE, transmittance)
    return unclamped, alpha, blends, weight, transmittance


@strict_inlined_function()
def _lets_light_through(behind_color, behind_scalar):
    """Whether any pixel of either layer does."""
    nearly_opaque = simd.broadcast(TRANSMITTANCE_MIN)
    return simd.any_lane((behind_color >= nearly_opaque) | (behind_scalar >= nearly_opaque))


@strict_inlined_function()
def _no_sums():
    return 0


@strict_inlined_function()
def _keep_no_sums(out, position, sums):
    pass


@strict_inlined_function()
def _accumulate(planes, at, weight, value):
    simd.store(planes, at, simd.load(planes, at) + weight * simd.broadcast(value))


@strict_inlined_function()
def _blend_layer(planes, at, splats, record, layer, channels, gaussian):
    """Blend one layer of a splat, of 3 channels or 1, into a vector of pixels; their transmittance
    behind it. The arguments are those of ``_contribution``."""
    _, _, _, weight, transmittance = _contribution(planes, at, splats, record, layer, gaussian)
    _accumulate(planes, at + DEPTH, weight, splats[record + splat.DEPTH])
    for channel in range(channels):
        feature = splats[record + layer + 1 + channel]
        _accumulate(planes, at + FEATURES + channel * TILE_PIXELS, weight, feature)
    return transmittance


@strict_inlined_function()
def _blend_splat(planes, at, splats, record, gaussian, offsets, sums):
    color = _blend_layer(planes, _COLOR + at, splats, record, splat.COLOR, 3, gaussian)
    scalar = _blend_layer(planes, _SCALAR + at, splats, record, splat.SCALAR, 1, gaussian)
    return sums, _lets_light_through(color, scalar)


_blend_tile = _walk_of(_no_sums, _blend_splat, _keep_no_sums)


@strict_inner_function()
def _write_layer(planes, layer, channels, background, x0, y0, images):
    """A layer's planes -> pixels of its images, over the background."""
    height, width = images.depth.shape
    image, depth = address(images.image, 0), address(images.depth, 0)
    transmittances = address(images.transmittance, 0)
    for row in range(min(TILE_HEIGHT, height - y0)):
        for column in range(min(TILE_WIDTH, width - x0)):
            at = layer + row * TILE_WIDTH + column
            pixel = (y0 + row) * width + x0 + column
            transmittance = planes[at + TRANSMITTANCE]
            for channel in range(channels):
                feature = planes[at + FEATURES + channel * TILE_PIXELS]
                image[pixel * channels + channel] = feature + transmittance * background[channel]
            depth[pixel] = planes[at + DEPTH]
            transmittances[pixel] = transmittance


@strict_parallel_kernel()
def blend(splats, tile_splats, tile_starts, backgrounds, color, scalar):
    """Fill the images of both layers, of 3 channels and of 1.

    Args:
        splats: records, nearest first, [V, 16].
        backgrounds: red, green, blue, temperature, [4].
        color, scalar: ``LayerImages``, filled.
    """
    height, width = color.depth.shape
    tiles = tile_starts.size - 1
    for index in prange(tiles):
        tile, x0, y0 = _tile(index, tiles, width)
        planes = simd.stack_floats(_FLOATS)
        _open_transmittance(planes, _COLOR, x0, y0, width, height)
        _open_transmittance(planes, _SCALAR, x0, y0, width, height)
        first, last = tile_starts[tile], tile_starts[tile + 1]
        _blend_tile(planes, address(splats, 0), tile_splats, first, last, x0, y0, planes)
        _write_layer(planes, _COLOR, 3, address(backgrounds, 0), x0, y0, color)
        _write_layer(planes, _SCALAR, 1, address(backgrounds, 3), x0, y0, scalar)


@strict_inner_function()
def _read_layer(planes, layer, behind, channels, x0, y0, images, grads):
    """The gradients of a layer's pixels into planes, and R at its start."""
    height, width = images.depth.shape
    image, grad_image = address(images.image, 0), address(grads.image, 0)
    depth, grad_depth = address(images.depth, 0), address(grads.depth, 0)
    transmittance = address(images.transmittance, 0)
    grad_transmittance = address(grads.transmittance, 0)
    for row in range(min(TILE_HEIGHT, height - y0)):
        for column in range(min(TILE_WIDTH, width - x0)):
            at = layer + row * TILE_WIDTH + column
            pixel = (y0 + row) * width + x0 + column
            grad = grad_depth[pixel]
            planes[at + DEPTH] = grad
            total = grad * depth[pixel] + grad_transmittance[pixel] * transmittance[pixel]
            for channel in range(channels):
                grad = grad_image[pixel * channels + channel]
                planes[at + FEATURES + channel * TILE_PIXELS] = grad
                total += grad * image[pixel * channels + channel]
            planes[at + behind] = total


@strict_inlined_function()
def _backward_layer(planes, at, behind, splats, record, layer, channels, gaussian, sums):
    """One layer of a splat in a vector of pixels: α ∂L/∂α, the transmittance behind it, and the new
    sums.

    Args:
        planes, at, behind: the tile's planes, the offset of the vector in the layer's first plane,
            and from there that of the plane of R.
        splats, record: the records, and the offset of this splat's.
        layer: the layer's part of the record.
        channels: 3 or 1.
        gaussian: G' at the pixels.
        sums: over the vectors so far, of α ∂L/∂α and of the gradients of the depth and of three
            features.
    """
    sum_alpha, sum_depth, sum_0, sum_1, sum_2 = sums
    unclamped, alpha, blends, weight, transmittance = _contribution(
        planes, at, splats, record, layer, gaussian
    )
    grad = simd.load(planes, at + DEPTH)
    own = grad * simd.broadcast(splats[record + splat.DEPTH])
    sum_depth = sum_depth + weight * grad
    grad = simd.load(planes, at + FEATURES)
    own = own + grad * simd.broadcast(splats[record + layer + 1])
    sum_0 = sum_0 + weight * grad
    if channels == 3:
        grad = simd.load(planes, at + FEATURES + TILE_PIXELS)
        own = own + grad * simd.broadcast(splats[record + layer + 2])
        sum_1 = sum_1 + weight * grad
        grad = simd.load(planes, at + FEATURES + 2 * TILE_PIXELS)
        own = own + grad * simd.broadcast(splats[record + layer + 3])
        sum_2 = sum_2 + weight * grad
    own = weight * own
    rest = simd.load(planes, at + behind) - own
    simd.store(planes, at + behind, rest)
    grad_alpha = own - rest * (alpha / (simd.broadcast(ONE) - alpha))
    grad_alpha = simd.select(
        blends & (unclamped < simd.broadcast(ALPHA_MAX)), grad_alpha, simd.broadcast(ZERO)
    )
    return grad_alpha, transmittance, (sum_alpha + grad_alpha, sum_depth, sum_0, sum_1, sum_2)


@strict_inlined_function()
def _add_geometry(moments, grad_exponent, across, dy):
    """Moments of α ∂L/∂α over the offsets from μ', in the order GRAD_ACROSS to GRAD_DY_DY."""
    grad_across, grad_dy = grad_exponent * across, grad_exponent * dy
    return (
        moments[0] + grad_across,
        moments[1] + grad_dy,
        moments[2] + grad_across * across,
        moments[3] + grad_across * dy,
        moments[4] + grad_dy * dy,
    )


@strict_inlined_function()
def _zero_sums():
    """Zero sums for the geometry, the colour layer and the scalar layer."""
    zero = simd.broadcast(ZERO)
    zeros = (zero, zero, zero, zero, zero)
    return zeros, zeros, zeros


@strict_inlined_function()
def _differentiate_splat(planes, at, splats, record, gaussian, offsets, sums):
    geometry, color, scalar = sums
    grad_color, behind_color, color = _backward_layer(
        planes, _COLOR + at, _BEHIND_COLOR, splats, record, splat.COLOR, 3, gaussian, color
    )
    grad_scalar, behind_scalar, scalar = _backward_layer(
        planes, _BACKWARD_SCALAR + at, _BEHIND_SCALAR, splats, record, splat.SCALAR, 1, gaussian,
        scalar,
    )  # fmt: skip
    geometry = _add_geometry(geometry, grad_color + grad_scalar, offsets[1], offsets[2])
    return (geometry, color, scalar), _lets_light_through(behind_color, behind_scalar)


@strict_inlined_function()
def _store_pair(pair_grads, position, sums):
    geometry, color, scalar = sums
    record = (
        *geometry, color[1] + scalar[1],
        color[0], color[2], color[3], color[4], scalar[0], scalar[2],
    )  # fmt: skip
    simd.store_sums(pair_grads, position * splat.GRAD_FLOATS, record)


_differentiate_tile = _walk_of(_zero_sums, _differentiate_splat, _store_pair)


@strict_parallel_kernel()
def blend_backward(
    splats, tile_splats, tile_starts, color, scalar, grad_color, grad_scalar, pair_grads
):
    """Fill ``pair_grads`` [P, 12], the gradient moments of every (tile, splat) pair.

    Args:
        splats: records, nearest first, [V, 16].
        color, scalar: ``LayerImages`` that ``blend`` filled; the ``grad_`` arguments are theirs.
    """
    height, width = color.depth.shape
    tiles = tile_starts.size - 1
    for index in prange(tiles):
        tile, x0, y0 = _tile(index, tiles, width)
        planes, grads = simd.stack_floats(_BACKWARD_FLOATS), address(pair_grads, 0)
        _open_transmittance(planes, _COLOR, x0, y0, width, height)
        _open_transmittance(planes, _BACKWARD_SCALAR, x0, y0, width, height)
        _read_layer(planes, _COLOR, _BEHIND_COLOR, 3, x0, y0, color, grad_color)
        _read_layer(planes, _BACKWARD_SCALAR, _BEHIND_SCALAR, 1, x0, y0, scalar, grad_scalar)
        first, last = tile_starts[tile], tile_starts[tile + 1]
        end = _differentiate_tile(
            planes, address(splats, 0), tile_splats, first, last, x0, y0, grads
        )
        for rest in range(end * splat.GRAD_FLOATS, last * splat.GRAD_FLOATS):
            grads[rest] = ZERO


@strict_inlined_function()
def _pass_surface(planes, at, splats, record, gaussian, offsets, sums):
    """Let a splat take its share of T in a vector of pixels, and of the surface; live are pixels
    where that goes on behind it."""
    begins, ends = simd.broadcast(SURFACE_BEGINS), simd.broadcast(SURFACE_ENDS)
    ahead = simd.load(planes, at + TRANSMITTANCE)
    _, _, _, _, behind = _contribution(planes, at, splats, record, splat.COLOR, gaussian)
    centre, zero = simd.broadcast(splats[record + splat.DEPTH]), simd.broadcast(ZERO)
    nearness = simd.broadcast(ONE)
    nearness = nearness - simd.broadcast(splats[record + _SLOPE_X]) * offsets[0]
    nearness = nearness - simd.broadcast(splats[record + _SLOPE_Y]) * offsets[2]
    least = simd.broadcast(LEAST_NEARNESS)
    depth = centre / simd.select(least < nearness, nearness, least)
    share = simd.minimum(ahead, begins) - simd.select(ends < behind, behind, ends)
    share = simd.select(zero < share, share, zero)
    simd.store(planes, at + _SHARES, simd.load(planes, at + _SHARES) + share)
    simd.store(planes, at + _SHARED_DEPTHS, simd.load(planes, at + _SHARED_DEPTHS) + share * depth)
    return sums, simd.any_lane(ends < behind)


_find_surface = _walk_of(_no_sums, _pass_surface, _keep_no_sums)


@strict_inner_function()
def _median(planes, pixel):
    """The depth of the surface at a pixel; NaN where more than half of the light passes."""
    if planes[pixel + TRANSMITTANCE] > HALF:
        return NAN
    return planes[pixel + _SHARED_DEPTHS] / planes[pixel + _SHARES]


@strict_parallel_kernel()
def median(splats, tile_splats, tile_starts, depth):
    """Fill the median depth [H, W] of the first layer, whose opacities are at ``splat.COLOR``.

    Args:
        splats: records, nearest first, [V, 16].
        depth: NaN where more than half of the light passes all splats.
    """
    height, width = depth.shape
    tiles = tile_starts.size - 1
    for index in prange(tiles):
        tile, x0, y0 = _tile(index, tiles, width)
        planes = simd.stack_floats(_MEDIAN_FLOATS)
        _open_transmittance(planes, 0, x0, y0, width, height)
        first, last = tile_starts[tile], tile_starts[tile + 1]
        _find_surface(planes, address(splats, 0), tile_splats, first, last, x0, y0, planes)
        for row in range(min(TILE_HEIGHT, height - y0)):
            for column in range(min(TILE_WIDTH, width - x0)):
                depth[y0 + row, x0 + column] = _median(planes, row * TILE_WIDTH + column)
