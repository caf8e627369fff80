"""Backward of the alpha blending: the same walk, front to back, with one running scalar per layer
and pixel.

With g the gradient of a pixel, let R_i = Σ_{j>i} w_j (g·f_j) + T_end (g·background + g_T): all that
lies behind the splat i. Then ∂L/∂α_i = T_i (g·f_i) − R_i / (1 − α_i). R starts as g·pixel + T_end
g_T and loses w_i (g·f_i) at each step; nothing is divided by T. Every (tile, splat) pair has its
own record of sums, so no atomics are needed and the result does not depend on the number of
threads.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from mrgs.kernels.jit import strict_inlined_function, strict_inner_function, strict_parallel_kernel
from mrgs.kernels.rasterize.cpu.blend import (
    ALL_VECTORS,
    ALPHA_MAX,
    DEPTH,
    FEATURES,
    ONE,
    TILE_PIXELS,
    TRANSMITTANCE_MIN,
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
    pointer,
    prefetch,
    read,
    select,
    stack_floats,
    store,
    store_sums,
    write,
)
from mrgs.kernels.rasterize.cpu.tiles import PREFETCH_AHEAD, TILE_HEIGHT, TILE_WIDTH
from mrgs.rasterizer import splat

# A layer's planes: T, then the gradients of depth and features where ``blend`` keeps depth and
# features, then R.
_COLOR = 0
_BEHIND_COLOR = 5 * TILE_PIXELS
_SCALAR = 6 * TILE_PIXELS
_BEHIND_SCALAR = 3 * TILE_PIXELS
TILE_FLOATS = 10 * TILE_PIXELS


@strict_inner_function()
def _read_layer(
    planes, layer, behind, channels, x0, y0, width, height, image, depth, transmittance,
    grad_image, grad_depth, grad_transmittance,
):  # fmt: skip
    """The gradients of a layer's pixels into planes, and R at its start."""
    for row in range(min(TILE_HEIGHT, height - y0)):
        for column in range(min(TILE_WIDTH, width - x0)):
            at = layer + row * TILE_WIDTH + column
            pixel = (y0 + row) * width + x0 + column
            grad = read(grad_depth, pixel)
            write(planes, at + DEPTH, grad)
            total = grad * read(depth, pixel) + read(grad_transmittance, pixel) * read(
                transmittance, pixel
            )
            for channel in range(channels):
                grad = read(grad_image, pixel * channels + channel)
                write(planes, at + FEATURES + channel * TILE_PIXELS, grad)
                total += grad * read(image, pixel * channels + channel)
            write(planes, at + behind, total)


@strict_inlined_function()
def _backward_layer(planes, at, behind, splats, record, layer, channels, gaussian, sums):
    """One layer of a splat in a row: α ∂L/∂α at its pixels, the row's transmittance behind it, and
    the new sums.

    Args:
        planes, at, behind: the tile's planes, the offset of the row in the layer's first plane, and
            from there that of the plane of R.
        splats, record: the records, and the offset of this splat's.
        layer: the layer's part of the record.
        channels: 3 or 1.
        gaussian: G' at the row's pixels.
        sums: over the rows so far, of α ∂L/∂α and of the gradients of the depth and of three
            features.
    """
    sum_alpha, sum_depth, sum_0, sum_1, sum_2 = sums
    unclamped, alpha, blends, weight, transmittance = contribution(
        planes, at, splats, record, layer, gaussian
    )
    grad = load(planes, at + DEPTH)
    own = grad * broadcast(read(splats, record + splat.DEPTH))
    sum_depth = sum_depth + weight * grad
    grad = load(planes, at + FEATURES)
    own = own + grad * broadcast(read(splats, record + layer + 1))
    sum_0 = sum_0 + weight * grad
    if channels == 3:
        grad = load(planes, at + FEATURES + TILE_PIXELS)
        own = own + grad * broadcast(read(splats, record + layer + 2))
        sum_1 = sum_1 + weight * grad
        grad = load(planes, at + FEATURES + 2 * TILE_PIXELS)
        own = own + grad * broadcast(read(splats, record + layer + 3))
        sum_2 = sum_2 + weight * grad
    own = weight * own
    rest = load(planes, at + behind) - own
    store(planes, at + behind, rest)
    grad_alpha = own - rest * (alpha / (broadcast(ONE) - alpha))
    grad_alpha = select(blends & (unclamped < broadcast(ALPHA_MAX)), grad_alpha, broadcast(ZERO))
    return grad_alpha, transmittance, (sum_alpha + grad_alpha, sum_depth, sum_0, sum_1, sum_2)


@strict_inlined_function()
def _add_geometry(moments, grad_exponent, across, dy):
    """Moments of α ∂L/∂α over the pixels' offsets from μ', in the order GRAD_ACROSS to
    GRAD_DY_DY."""
    grad_across, grad_dy = grad_exponent * across, grad_exponent * dy
    return (
        moments[0] + grad_across,
        moments[1] + grad_dy,
        moments[2] + grad_across * across,
        moments[3] + grad_across * dy,
        moments[4] + grad_dy * dy,
    )


@strict_inner_function()
def _backward_tile(planes, splats, tile_splats, first, last, x0, y0, pair_grads):
    """The walk of ``blend._blend_tile`` again, summing the moments of every splat of the list."""
    nearly_opaque = broadcast(TRANSMITTANCE_MIN)
    zero = broadcast(ZERO)
    centres_x = lane_columns(TILE_WIDTH) + broadcast(np.float32(x0 + 0.5))
    centres_y = lane_rows(TILE_WIDTH) + broadcast(np.float32(y0 + 0.5))
    live_vectors = ALL_VECTORS
    for position in range(first, last):
        record = tile_splats[position] * splat.SPLAT_FLOATS
        prefetch(splats, tile_splats[min(position + PREFETCH_AHEAD, last - 1)] * splat.SPLAT_FLOATS)
        geometry = (zero, zero, zero, zero, zero)
        color = (zero, zero, zero, zero, zero)
        scalar = (zero, zero, zero, zero, zero)
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
            grad_color, behind_color, color = _backward_layer(
                planes, _COLOR + at, _BEHIND_COLOR, splats, record, splat.COLOR, 3, gaussian, color
            )
            grad_scalar, behind_scalar, scalar = _backward_layer(
                planes,
                _SCALAR + at,
                _BEHIND_SCALAR,
                splats,
                record,
                splat.SCALAR,
                1,
                gaussian,
                scalar,
            )
            geometry = _add_geometry(geometry, grad_color + grad_scalar, across, dy)
            if not any_lane((behind_color >= nearly_opaque) | (behind_scalar >= nearly_opaque)):
                live_vectors &= ~(1 << vector)
        sums = (
            *geometry,
            color[1] + scalar[1],
            color[0],
            color[2],
            color[3],
            color[4],
            scalar[0],
            scalar[2],
        )
        store_sums(pair_grads, position * splat.GRAD_FLOATS, sums)
        if live_vectors == 0:
            for rest in range((position + 1) * splat.GRAD_FLOATS, last * splat.GRAD_FLOATS):
                write(pair_grads, rest, ZERO)
            break


@strict_parallel_kernel()
def blend_backward(
    splats, tile_splats, tile_starts, color, depth_color, transmittance_color, scalar, depth_scalar,
    transmittance_scalar, grad_color, grad_depth_color, grad_transmittance_color, grad_scalar,
    grad_depth_scalar,
    grad_transmittance_scalar, pair_grads,
):  # fmt: skip
    """Fill ``pair_grads`` [P, 12], the gradient moments of every (tile, splat) pair.

    Args:
        splats: records in depth order, [V, 16].
        tile_splats, tile_starts: the tiles' lists.
        color, depth_color, ..., transmittance_scalar: what ``blend`` wrote.
        grad_*: the gradients of these.
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
        _read_layer(
            planes, _COLOR, _BEHIND_COLOR, 3, x0, y0, width, height,
            pointer(color), pointer(depth_color), pointer(transmittance_color),
            pointer(grad_color), pointer(grad_depth_color), pointer(grad_transmittance_color),
        )  # fmt: skip
        _read_layer(
            planes, _SCALAR, _BEHIND_SCALAR, 1, x0, y0, width, height,
            pointer(scalar), pointer(depth_scalar), pointer(transmittance_scalar),
            pointer(grad_scalar), pointer(grad_depth_scalar), pointer(grad_transmittance_scalar),
        )  # fmt: skip
        _backward_tile(
            planes,
            pointer(splats),
            tile_splats,
            tile_starts[tile],
            tile_starts[tile + 1],
            x0,
            y0,
            pointer(pair_grads),
        )
