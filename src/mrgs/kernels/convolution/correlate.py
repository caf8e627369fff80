"""Convolution of one plane with 3 × 3 weights, and the gradient by these weights."""

from __future__ import annotations

from numba import prange

from mrgs.kernels.address import address
from mrgs.kernels.jit import inner_function, parallel_kernel, reordering_inner_function


@parallel_kernel()
def correlate(padded, weights, result):
    """The nine weights over each pixel's neighbourhood: [H + 2, W + 2], [9] -> [H, W]."""
    height, width = result.shape
    for row in prange(height):
        _correlate_row(padded, row, weights, address(result, row * width), width)


@inner_function()
def _correlate_row(padded, row, weights, result, count):
    stride = padded.shape[1]
    a, b, c = (
        address(padded, row * stride),
        address(padded, (row + 1) * stride),
        address(padded, (row + 2) * stride),
    )
    a0, a1, a2, b0, b1 = weights[0], weights[1], weights[2], weights[3], weights[4]
    b2, c0, c1, c2 = weights[5], weights[6], weights[7], weights[8]
    for i in range(count):
        above = a0 * a[i] + a1 * a[i + 1] + a2 * a[i + 2]
        same = b0 * b[i] + b1 * b[i + 1] + b2 * b[i + 2]
        below = c0 * c[i] + c1 * c[i + 1] + c2 * c[i + 2]
        result[i] = above + same + below


@parallel_kernel()
def weights_gradient(padded, gradient, sums):
    """By the nine weights: each row's part in double precision [H, 9], from the gradient by the
    result [H, W]."""
    height, width = gradient.shape
    for row in prange(height):
        for tap in range(9):
            values = address(padded, (row + tap // 3) * padded.shape[1] + tap % 3)
            sums[row, tap] = _dot(address(gradient, row * width), values, width)


@reordering_inner_function()
def _dot(a, b, count):
    total = 0.0
    for i in range(count):
        total += a[i] * b[i]
    return total
