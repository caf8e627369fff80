"""The losses that compare images, for float32 and float64 on the CPU."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numba import prange
from torch import Tensor

from mrgs.kernels import ssim as ssim_losses
from mrgs.kernels.jit import address, inner_function, moved, parallel_kernel
from mrgs.kernels.require import require
from mrgs.kernels.ssim import Dissimilarity, Scalars
from mrgs.method.losses.ssim import WEIGHTS

RADIUS = 5
TAPS = 2 * RADIUS + 1

STRIP_ROWS = 60
"""A strip reads ten rows beyond its ends: long ones repeat less, short ones use more threads."""

BLOCK = 512
"""Values of a row that are worked on at once, so that they stay in the fastest cache."""

MEAN_X, SQUARES, PRODUCT, MEAN_Y, ERROR = range(0, 5 * BLOCK, BLOCK)
"""Offsets in a block: of μ_x, S, P and μ_y, later of the derivatives by these, and of 1 − SSIM."""


class ImagePair(NamedTuple):
    """Two images to compare and the arrays for the results; float32 or float64 throughout.

    Attributes:
        x: an image as it lies in memory, [H, W·C], C-contiguous as all arrays here.
        y: the other image, [H, W·C].
        weights: of each value in the sum, [H, W·C], or [1, W·C] for all rows alike; where 0, both
            images are read as 0.
        channels: C, how far the window's taps along a row lie apart.
        window: weights of the window's first six taps, the rest by symmetry.
        scalars: those of ``ssim.Compare``; the first two must add up to 1.
        grad_x: receives the gradient by x, [H, W·C]; [0, 0] if not wanted.
        grad_y: receives the gradient by y, [H, W·C]; [0, 0] if not wanted.
        errors: receives 1 − SSIM of each value, [H, W·C]; [0, 0] if not wanted.
        sums: of zeros, float64, [number of strips, W·C]; receives each strip's sums over its rows.
    """

    x: np.ndarray
    y: np.ndarray
    weights: np.ndarray
    channels: int
    window: np.ndarray
    scalars: np.ndarray
    grad_x: np.ndarray
    grad_y: np.ndarray
    errors: np.ndarray
    sums: np.ndarray


@parallel_kernel()
def _compare(comparison):
    """What ``ssim.Compare`` sums, as the sums over each strip and column."""
    for strip in prange(comparison.sums.shape[0]):
        # prange counts in uint64, and uint64 less int64 is float64 in Numba
        _walk_strip(comparison, np.int64(strip))


@inner_function()
def _walk_strip(comparison, strip):
    height, width = comparison.x.shape
    first, last = strip * STRIP_ROWS, min((strip + 1) * STRIP_ROWS, height)
    dtype = comparison.x.dtype
    rows = np.zeros((5, width + 2 * RADIUS * comparison.channels), dtype)
    moments = np.zeros((4, TAPS * width), dtype)
    derivatives = np.zeros((4 if comparison.grad_y.size else 3, TAPS * width), dtype)
    block = np.zeros((5, BLOCK), dtype)
    for row in range(first - 2 * RADIUS, last + 2 * RADIUS):
        _enter_moments(comparison, row, rows, moments)
        if row >= first:
            _enter_derivatives(comparison, row - RADIUS, moments, block, rows, derivatives)
            if first <= row - RADIUS < last:
                _add_errors(comparison, row - RADIUS, rows, strip)
        if row >= first + 2 * RADIUS:
            _store_gradients(comparison, row - 2 * RADIUS, derivatives, block)


@inner_function()
def _enter_moments(comparison, row, rows, ring):
    """One row of x, y, x² + y² and x y, filtered along it, enters the ring."""
    height, width = comparison.x.shape
    if not 0 <= row < height:
        _clear_slot(ring, row % TAPS, width)
        return
    at = row * width
    weights = address(comparison.weights, at % comparison.weights.size)
    padding, padded_width = RADIUS * comparison.channels, rows.shape[1]
    x, squares = address(rows, padding), address(rows, padded_width + padding)
    product = address(rows, 2 * padded_width + padding)
    y = address(rows, 3 * padded_width + padding)
    _copy_counted(address(comparison.x, at), weights, x, width)
    _copy_counted(address(comparison.y, at), weights, y, width)
    for i in range(width):
        squares[i] = x[i] * x[i] + y[i] * y[i]
    for i in range(width):
        product[i] = x[i] * y[i]
    _filter_along(rows, comparison.channels, comparison.window, ring, row % TAPS, width)


@inner_function()
def _copy_counted(source, weights, result, count):
    zero = weights[0] - weights[0]
    for i in range(count):
        value = source[i]
        result[i] = value if weights[i] != zero else zero


@inner_function()
def _enter_derivatives(comparison, row, moments, block, rows, ring):
    """A row's derivatives by the moments, filtered along it, enter the ring, 1 − SSIM ``rows``."""
    height, width = comparison.x.shape
    if not 0 <= row < height:
        _clear_slot(ring, row % TAPS, width)
        return
    padding, padded_width = RADIUS * comparison.channels, rows.shape[1]
    for start in range(0, width, BLOCK):
        count = min(BLOCK, width - start)
        weights = address(comparison.weights, (row * width + start) % comparison.weights.size)
        _filter_across(moments, row, start, count, width, comparison.window, block)
        _differentiate_ssim(address(block, 0), weights, count, comparison.scalars)
        for k in range(rows.shape[0]):
            row_at = address(rows, k * padded_width + padding + start)
            _copy(address(block, k * BLOCK), row_at, count)
    _filter_along(rows, comparison.channels, comparison.window, ring, row % TAPS, width)


@inner_function()
def _differentiate_ssim(block, weights, count, scalars):
    """Moments to 1 − SSIM and the derivatives of weights dssim (1 − SSIM), each in its moment's
    place. SSIM = l s, l = (2 μ_x μ_y + c1) / (μ_x² + μ_y² + c1), s = (2 C_xy + c2) / (C_x + C_y +
    c2)."""
    dssim, c1, c2 = scalars[0], scalars[2], scalars[3]
    one = scalars[0] + scalars[1]  # a bare 1 or 2 would make float32 arithmetic float64
    two = one + one
    for i in range(count):
        mean_x, mean_y = block[MEAN_X + i], block[MEAN_Y + i]
        cross, both = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
        per_means, per_variances = one / (both + c1), one / (block[SQUARES + i] - both + c2)
        luminance = (two * cross + c1) * per_means
        structure = (two * (block[PRODUCT + i] - cross) + c2) * per_variances
        scale = -two * dssim * weights[i]
        by_means, by_variances = scale * structure * per_means, scale * luminance * per_variances
        block[MEAN_X + i] = by_means * (mean_y - luminance * mean_x) + by_variances * (
            structure * mean_x - mean_y
        )
        block[MEAN_Y + i] = by_means * (mean_x - luminance * mean_y) + by_variances * (
            structure * mean_y - mean_x
        )
        block[SQUARES + i] = -by_variances * structure
        block[PRODUCT + i] = by_variances
        block[ERROR + i] = one - luminance * structure


@inner_function()
def _huber_slope(difference, scalars):
    """The derivative of the Huber loss; of |x − y|, its sign."""
    one = scalars[0] + scalars[1]  # a bare 1 would make float32 arithmetic float64
    return min(max(scalars[4] * difference, -one), one)


@inner_function()
def _add_errors(comparison, row, rows, strip):
    """The row's part of the sum, column by column."""
    width = comparison.x.shape[1]
    at = row * width
    x, y = address(comparison.x, at), address(comparison.y, at)
    weights = address(comparison.weights, at % comparison.weights.size)
    errors = address(rows, 4 * rows.shape[1] + RADIUS * comparison.channels)
    totals, scalars = address(comparison.sums, strip * width), comparison.scalars
    dssim, l1, half_width = scalars[0], scalars[1], scalars[5]
    zero = dssim - dssim
    for i in range(width):
        difference = x[i] - y[i] if weights[i] != zero else zero
        slope = _huber_slope(difference, scalars)
        totals[i] += weights[i] * (
            l1 * slope * (difference - half_width * slope) + dssim * errors[i]
        )
    if comparison.errors.size:
        _copy(errors, address(comparison.errors, at), width)


@inner_function()
def _store_gradients(comparison, row, derivatives, block):
    """The gradients of one row from its derivatives, filtered across, and L1's own."""
    width = comparison.x.shape[1]
    for start in range(0, width, BLOCK):
        count, at = min(BLOCK, width - start), row * width + start
        _filter_across(derivatives, row, start, count, width, comparison.window, block)
        weights = address(comparison.weights, at % comparison.weights.size)
        x, y = address(comparison.x, at), address(comparison.y, at)
        means, scalars = address(block, 0), comparison.scalars
        if comparison.grad_x.size:
            result = address(comparison.grad_x, at)
            _gradient(x, y, weights, means, MEAN_X, count, scalars, result)
        if comparison.grad_y.size:
            result = address(comparison.grad_y, at)
            _gradient(y, x, weights, means, MEAN_Y, count, scalars, result)


@inner_function()
def _gradient(x, y, weights, block, mean, count, scalars, result):
    """Gradient with respect to x; ``mean`` is the offset of w ∗ ∂L/∂μ_x in the block."""
    l1 = scalars[1]
    zero = l1 - l1
    for i in range(count):
        step = l1 * weights[i] * _huber_slope(x[i] - y[i], scalars)
        gradient = step + block[mean + i] + x[i] * block[SQUARES + i] + y[i] * block[PRODUCT + i]
        result[i] = gradient if weights[i] != zero else zero


@inner_function()
def _filter_along(rows, channels, window, ring, slot, width):
    """The window along each of as many padded rows as the ring holds, into its ``slot``."""
    for k in range(ring.shape[0]):
        row = address(rows, k * rows.shape[1])
        result = address(ring, k * ring.shape[1] + slot * width)
        _weigh(row, 0, channels, window, result, width)


@inner_function()
def _filter_across(ring, row, start, count, width, window, block):
    """The window across the eleven rows about ``row``, ``count`` values from ``start`` on."""
    for k in range(ring.shape[0]):
        values, result = address(ring, k * ring.shape[1] + start), address(block, k * BLOCK)
        _weigh(values, row - RADIUS, width, window, result, count)


@inner_function()
def _weigh(values, first, spacing, window, result, count):
    """The window over eleven runs of values, the k-th (first + k) mod 11 spacings behind. Two runs
    of each weight at a time, in two loops: LLVM vectorises loops over few addresses only."""
    a, a0, a1 = window[0], _run(values, first, spacing), _run(values, first + 10, spacing)
    b, b0, b1 = window[1], _run(values, first + 1, spacing), _run(values, first + 9, spacing)
    c, c0, c1 = window[2], _run(values, first + 2, spacing), _run(values, first + 8, spacing)
    for i in range(count):
        result[i] = a * (a0[i] + a1[i]) + b * (b0[i] + b1[i]) + c * (c0[i] + c1[i])
    d, d0, d1 = window[3], _run(values, first + 3, spacing), _run(values, first + 7, spacing)
    e, e0, e1 = window[4], _run(values, first + 4, spacing), _run(values, first + 6, spacing)
    f, f0 = window[5], _run(values, first + 5, spacing)
    for i in range(count):
        result[i] += d * (d0[i] + d1[i]) + e * (e0[i] + e1[i]) + f * f0[i]


@inner_function()
def _run(values, tap, spacing):
    return moved(values, tap % TAPS * spacing)


@inner_function()
def _copy(source, result, count):
    for i in range(count):
        result[i] = source[i]


@inner_function()
def _clear_slot(ring, slot, width):
    zero = ring.dtype.type(0)
    for k in range(ring.shape[0]):
        row = address(ring, k * ring.shape[1] + slot * width)
        for i in range(width):
            row[i] = zero


def compare(
    x: Float[Tensor, "h w c"],
    y: Float[Tensor, "h w c"],
    weights: Float[Tensor, "h2 w"],
    scalars: Scalars,
    wants_errors: bool,
) -> Dissimilarity:
    """``ssim.Compare``. ValueError for tensors of other sizes or types."""
    require("x", x, (None, None, None), (torch.float32, torch.float64))
    require("y", y, x.shape, (x.dtype,))
    height, width, channels = x.shape
    require("weights", weights, (1 if len(weights) == 1 else height, width), (x.dtype,))
    in_memory = (height, width * channels)
    errors = x.new_empty(x.shape if wants_errors else (0, 0))
    gradients = [x.new_empty(in_memory if tensor.requires_grad else (0, 0)) for tensor in (x, y)]
    sums = torch.zeros(math.ceil(height / STRIP_ROWS), width * channels, dtype=torch.float64)
    _compare(
        ImagePair(
            x=x.detach().reshape(in_memory).contiguous().numpy(),
            y=y.detach().reshape(in_memory).contiguous().numpy(),
            weights=weights.detach().repeat_interleave(channels, dim=1).numpy(),
            channels=channels,
            window=WEIGHTS[: TAPS // 2 + 1].to(x.dtype).numpy(),
            scalars=x.new_tensor(scalars).numpy(),
            grad_x=gradients[0].numpy(),
            grad_y=gradients[1].numpy(),
            errors=errors.flatten(1).numpy(),
            sums=sums.numpy(),
        )
    )
    grad_x, grad_y = (tensor.view(x.shape) if tensor.numel() else None for tensor in gradients)
    return Dissimilarity(sums.sum().item(), grad_x, grad_y, errors if wants_errors else None)


photometric_loss = partial(ssim_losses.photometric_loss, compare)
boltzmann_loss = partial(ssim_losses.boltzmann_loss, compare)
