"""A separable filter of one plane: weighted sums down the columns, then along the rows."""

from __future__ import annotations

import numpy as np
from numba import prange

from mrgs.kernels.address import address
from mrgs.kernels.jit import inner_function, parallel_kernel


@parallel_kernel()
def filter_plane(padded, down, across, result):
    """Weights [2R + 1] down and across: [H + 2R, W + 2R] -> [H, W]."""
    height, width = result.shape
    for row in prange(height):
        line = np.zeros(padded.shape[1], padded.dtype)
        _add_rows(padded, row, down, address(line, 0), padded.shape[1])
        _filter_line(address(line, 0), across, address(result, row * width), width)


@inner_function()
def _add_rows(padded, first, weights, line, count):
    for k in range(weights.size):
        weight, values = weights[k], address(padded, (first + k) * padded.shape[1])
        for i in range(count):
            line[i] += weight * values[i]


@inner_function()
def _filter_line(line, weights, result, count):
    for i in range(count):
        result[i] = weights[0] * line[i]
    for k in range(1, weights.size):
        weight = weights[k]
        for i in range(count):
            result[i] += weight * line[i + k]
