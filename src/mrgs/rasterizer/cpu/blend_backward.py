"""Backward of the alpha blending: the same walk, front to back, with one running scalar per layer and pixel.

With g the gradient of a pixel, let R_i = Σ_{j>i} w_j (g·f_j) + T_end (g·background − g_alpha): all that lies behind the
splat i. Then ∂L/∂α_i = T_i (g·f_i) − R_i / (1 − α_i). R starts as g·pixel − T_end g_alpha and loses w_i (g·f_i) at each
step; nothing is divided by T. Every (tile, splat) pair has its own record of sums, so no atomics are needed and the
result does not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from mrgs.rasterizer.cpu import splat
from mrgs.rasterizer.cpu.blend import (
    ALL_ROWS,
    ALPHA_MAX,
    ALPHA_MIN,
    IMAGE_ALPHA_RGB,
    IMAGE_ALPHA_THERMAL,
    IMAGE_DEPTH_RGB,
    IMAGE_DEPTH_THERMAL,
    TILE_PIXELS,
    TRANSMITTANCE_MIN,
    TRANSMITTANCE_RGB,
    TRANSMITTANCE_THERMAL,
    interleaved,
    open_transmittance,
    row_range,
)
from mrgs.rasterizer.cpu.jit import kernel, parallel_kernel
from mrgs.rasterizer.cpu.simd import any_lane, exp2, lane_indices, load, minimum, select, store, sum_lanes
from mrgs.rasterizer.cpu.simd import splat as spread
from mrgs.rasterizer.cpu.tiles import TILE_HEIGHT, TILE_WIDTH

# Offsets of the tile's planes behind the two transmittances.
_GRAD_RED = 2 * TILE_PIXELS
_GRAD_GREEN = 3 * TILE_PIXELS
_GRAD_BLUE = 4 * TILE_PIXELS
_GRAD_DEPTH_RGB = 5 * TILE_PIXELS
_GRAD_TEMPERATURE = 6 * TILE_PIXELS
_GRAD_DEPTH_THERMAL = 7 * TILE_PIXELS
_BEHIND_RGB = 8 * TILE_PIXELS
_BEHIND_THERMAL = 9 * TILE_PIXELS
_PLANES = 10


@kernel()
def _read_tile(planes, image, grad_image, x0, y0):
    """Gradients of the pixels into planes, and R at its start."""
    for row in range(min(TILE_HEIGHT, image.shape[0] - y0)):
        for column in range(min(TILE_WIDTH, image.shape[1] - x0)):
            at = row * TILE_WIDTH + column
            pixel, g = image[y0 + row, x0 + column], grad_image[y0 + row, x0 + column]
            planes[_GRAD_RED + at] = g[0]
            planes[_GRAD_GREEN + at] = g[1]
            planes[_GRAD_BLUE + at] = g[2]
            planes[_GRAD_TEMPERATURE + at] = g[3]
            planes[_GRAD_DEPTH_RGB + at] = g[IMAGE_DEPTH_RGB]
            planes[_GRAD_DEPTH_THERMAL + at] = g[IMAGE_DEPTH_THERMAL]
            behind = g[0] * pixel[0] + g[1] * pixel[1] + g[2] * pixel[2] + g[IMAGE_DEPTH_RGB] * pixel[IMAGE_DEPTH_RGB]
            behind -= (np.float32(1.0) - pixel[IMAGE_ALPHA_RGB]) * g[IMAGE_ALPHA_RGB]
            planes[_BEHIND_RGB + at] = behind
            behind = g[3] * pixel[3] + g[IMAGE_DEPTH_THERMAL] * pixel[IMAGE_DEPTH_THERMAL]
            behind -= (np.float32(1.0) - pixel[IMAGE_ALPHA_THERMAL]) * g[IMAGE_ALPHA_THERMAL]
            planes[_BEHIND_THERMAL + at] = behind


@kernel()
def _backward_tile(planes, splats, tile_splats, first, last, x0, y0, pair_grads):
    """The walk of ``blend._blend_tile`` again, summing the moments of every splat of the list."""
    one_over_255 = spread(ALPHA_MIN)
    alpha_max = spread(ALPHA_MAX)
    nearly_opaque = spread(TRANSMITTANCE_MIN)
    zero = spread(np.float32(0.0))
    one = spread(np.float32(1.0))
    centres_x = lane_indices() + spread(np.float32(x0 + 0.5))
    live_rows = ALL_ROWS
    for position in range(first, last):
        record = splats[tile_splats[position]]
        sum_rgb, sum_thermal = zero, zero
        sum_dx, sum_dy, sum_dxdx, sum_dxdy, sum_dydy = zero, zero, zero, zero, zero
        sum_red, sum_green, sum_blue, sum_temperature, sum_depth = zero, zero, zero, zero, zero
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
            grad_exponent = zero

            unclamped = spread(record[splat.OPACITY_RGB]) * gaussian
            alpha = minimum(unclamped, alpha_max)
            blends = (alpha >= one_over_255) & (transmittance_rgb >= nearly_opaque)
            if any_lane(blends):
                weight = select(blends, alpha * transmittance_rgb, zero)
                transmittance_rgb = transmittance_rgb - weight
                store(planes, TRANSMITTANCE_RGB + at, transmittance_rgb)
                grad_red, grad_green = load(planes, _GRAD_RED + at), load(planes, _GRAD_GREEN + at)
                grad_blue, grad_depth = load(planes, _GRAD_BLUE + at), load(planes, _GRAD_DEPTH_RGB + at)
                own = grad_red * spread(record[splat.RED]) + grad_green * spread(record[splat.GREEN])
                own = own + grad_blue * spread(record[splat.BLUE]) + grad_depth * spread(record[splat.DEPTH])
                own = weight * own
                behind = load(planes, _BEHIND_RGB + at) - own
                store(planes, _BEHIND_RGB + at, behind)
                grad_alpha = own - behind * (alpha / (one - alpha))
                grad_alpha = select(blends & (unclamped < alpha_max), grad_alpha, zero)
                sum_rgb = sum_rgb + grad_alpha
                grad_exponent = grad_alpha
                sum_red = sum_red + weight * grad_red
                sum_green = sum_green + weight * grad_green
                sum_blue = sum_blue + weight * grad_blue
                sum_depth = sum_depth + weight * grad_depth

            unclamped = spread(record[splat.OPACITY_THERMAL]) * gaussian
            alpha = minimum(unclamped, alpha_max)
            blends = (alpha >= one_over_255) & (transmittance_thermal >= nearly_opaque)
            if any_lane(blends):
                weight = select(blends, alpha * transmittance_thermal, zero)
                transmittance_thermal = transmittance_thermal - weight
                store(planes, TRANSMITTANCE_THERMAL + at, transmittance_thermal)
                grad_temperature = load(planes, _GRAD_TEMPERATURE + at)
                grad_depth = load(planes, _GRAD_DEPTH_THERMAL + at)
                own = grad_temperature * spread(record[splat.TEMPERATURE]) + grad_depth * spread(record[splat.DEPTH])
                own = weight * own
                behind = load(planes, _BEHIND_THERMAL + at) - own
                store(planes, _BEHIND_THERMAL + at, behind)
                grad_alpha = own - behind * (alpha / (one - alpha))
                grad_alpha = select(blends & (unclamped < alpha_max), grad_alpha, zero)
                sum_thermal = sum_thermal + grad_alpha
                grad_exponent = grad_exponent + grad_alpha
                sum_temperature = sum_temperature + weight * grad_temperature
                sum_depth = sum_depth + weight * grad_depth

            if not any_lane((transmittance_rgb >= nearly_opaque) | (transmittance_thermal >= nearly_opaque)):
                live_rows &= ~(1 << row)
            grad_dx = grad_exponent * dx
            grad_dy = grad_exponent * spread(dy)
            sum_dx = sum_dx + grad_dx
            sum_dy = sum_dy + grad_dy
            sum_dxdx = sum_dxdx + grad_dx * dx
            sum_dxdy = sum_dxdy + grad_dx * spread(dy)
            sum_dydy = sum_dydy + grad_dy * spread(dy)
        moments = pair_grads[position]
        moments[splat.GRAD_ALPHA_RGB] = sum_lanes(sum_rgb)
        moments[splat.GRAD_ALPHA_THERMAL] = sum_lanes(sum_thermal)
        moments[splat.GRAD_DX] = sum_lanes(sum_dx)
        moments[splat.GRAD_DY] = sum_lanes(sum_dy)
        moments[splat.GRAD_DXDX] = sum_lanes(sum_dxdx)
        moments[splat.GRAD_DXDY] = sum_lanes(sum_dxdy)
        moments[splat.GRAD_DYDY] = sum_lanes(sum_dydy)
        moments[splat.GRAD_RED] = sum_lanes(sum_red)
        moments[splat.GRAD_GREEN] = sum_lanes(sum_green)
        moments[splat.GRAD_BLUE] = sum_lanes(sum_blue)
        moments[splat.GRAD_TEMPERATURE] = sum_lanes(sum_temperature)
        moments[splat.GRAD_DEPTH] = sum_lanes(sum_depth)
        if live_rows == 0:
            pair_grads[position + 1 : last] = np.float32(0.0)
            break


@parallel_kernel()
def blend_backward(splats, tile_splats, tile_starts, image, grad_image, pair_grads):
    """Fill ``pair_grads`` [P, 12], the gradient moments of every (tile, splat) pair.

    Args:
        splats: records in depth order, [V, 16].
        tile_splats, tile_starts: the tiles' lists.
        image: what ``blend`` wrote, [H, W, 8].
        grad_image: ∂L/∂image, [H, W, 8].
    """
    height, width = image.shape[0], image.shape[1]
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    tiles = tile_starts.size - 1
    for index in prange(tiles):
        tile = interleaved(index, tiles)
        x0, y0 = tile % tiles_x * TILE_WIDTH, tile // tiles_x * TILE_HEIGHT
        planes = np.zeros(_PLANES * TILE_PIXELS, np.float32)
        open_transmittance(planes, x0, y0, width, height)
        _read_tile(planes, image, grad_image, x0, y0)
        _backward_tile(planes, splats, tile_splats, tile_starts[tile], tile_starts[tile + 1], x0, y0, pair_grads)
