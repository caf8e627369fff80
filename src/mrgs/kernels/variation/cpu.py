"""Total variation of an image with its gradient, in one pass.

The derivative of a |difference| is the sign of the difference times a, negative for the pixel
before it and positive for the pixel behind it: a pixel's gradient is the two steps that lead to it
less the two that leave it.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba import prange
from torch import Tensor

from mrgs.kernels.jit import address, inner_function, moved, parallel_kernel
from mrgs.kernels.known_gradient import with_gradients
from mrgs.kernels.require import require
from mrgs.kernels.variation import valid_pairs

STRIP_ROWS = 16
"""Rows of one task; the step that leads to its first row is computed by two tasks."""


def total_variation(
    image: Float[Tensor, "h w c"],
    valid: Bool[Tensor, "h w"] | None = None,
    row_weights: Float[Tensor, "h1 w"] | None = None,
    column_weights: Float[Tensor, "h w1"] | None = None,
) -> Float[Tensor, ""]:
    """``mrgs.method.losses.smoothness.total_variation`` for float32 or float64 on the CPU.

    Raises:
        ValueError: tensors of other sizes or types.
    """
    require("image", image, (None, None, None), (torch.float32, torch.float64))
    height, width, channels = image.shape
    pixels = image.detach().contiguous()
    pairs = [
        valid_pairs(image, axis, valid, weights)
        for axis, weights in enumerate((row_weights, column_weights))
    ]
    gradient, none = torch.empty_like(pixels), pixels.new_empty(0, 0)
    weights = [none if each is None else each.contiguous() for _, each in pairs]
    scales = pixels.new_tensor([1 / max(channels * int(counted), 1) for counted, _ in pairs])
    sums = torch.zeros(math.ceil(height / STRIP_ROWS), width * channels, dtype=torch.float64)
    sum_differences(
        pixels.flatten(1).numpy(), channels, *(each.numpy() for each in weights), scales.numpy(),
        gradient.flatten(1).numpy(), sums.numpy(),
    )  # fmt: skip
    return with_gradients(sums.sum().item(), [image], [gradient])


@parallel_kernel()
def sum_differences(image, channels, row_weights, column_weights, scales, gradient, sums):
    """Σ scale weight |first difference|, as the sums over each strip and column: of them, the sum.

    Args:
        image: as it lies in memory, [H, W·C].
        channels: C.
        row_weights: of the differences between neighbouring rows, [H − 1, W]; [0, 0] for 1.
        column_weights: of the differences between neighbouring columns, [H, W − 1]; [0, 0] for 1.
        scales: of all differences between rows and of all between columns, [2].
        gradient: receives the gradient, [H, W·C].
        sums: of zeros, float64, [number of strips, W·C]; receives each strip's sums over its rows.
    """
    for strip in prange(sums.shape[0]):
        # prange counts in uint64, and uint64 less int64 is float64 in Numba
        _walk_strip(
            image, channels, row_weights, column_weights, scales, gradient, sums, np.int64(strip)
        )


@inner_function()
def _walk_strip(image, channels, row_weights, column_weights, scales, gradient, sums, strip):
    """A row counts the differences within it and those to the next row."""
    height, width = image.shape
    first, last = strip * STRIP_ROWS, min((strip + 1) * STRIP_ROWS, height)
    buffers = np.zeros((4, width + channels), image.dtype)
    for row in range(max(first - 1, 0), last):
        _step_to_next_row(image, row, channels, row_weights, scales, buffers)
        if row >= first:
            totals = address(sums, strip * width)
            _finish_row(image, row, channels, column_weights, scales, buffers, gradient, totals)


@inner_function()
def _step_to_next_row(image, row, channels, weights, scales, buffers):
    """The steps between two rows, into one of the two last buffers; the other holds those from the
    row before."""
    height, width = image.shape
    factors, leaving = address(buffers, 0), address(buffers, (2 + row % 2) * buffers.shape[1])
    if row + 1 < height:
        _spread(weights, row, scales[0], channels, factors, width)
        _step(address(image, row * width), width, factors, width, leaving)
    else:
        for i in range(width):
            leaving[i] = 0


@inner_function()
def _finish_row(image, row, channels, weights, scales, buffers, gradient, totals):
    """The steps within a row, the gradient from all four steps, and the row's part of the sum."""
    height, width = image.shape
    pixels, result = address(image, row * width), address(gradient, row * width)
    factors, pitch = address(buffers, 0), buffers.shape[1]
    before, behind = address(buffers, pitch), address(buffers, pitch + channels)
    below, above = address(buffers, (2 + row % 2) * pitch), address(buffers, (3 - row % 2) * pitch)
    _spread(weights, row, scales[1], channels, factors, width - channels)
    _step(pixels, channels, factors, width - channels, behind)
    _add(pixels, channels, behind, width - channels, totals)
    if row + 1 < height:
        _add(pixels, width, below, width, totals)
    for i in range(width):
        result[i] = before[i] - behind[i] + above[i] - below[i]


@inner_function()
def _spread(weights, row, scale, channels, factors, count):
    """Each pixel's weight, times the scale, for each of its channels."""
    if weights.size == 0:
        for i in range(count):
            factors[i] = scale
        return
    for pixel in range(count // channels):
        for channel in range(channels):
            factors[pixel * channels + channel] = scale * weights[row, pixel]


@inner_function()
def _step(pixels, distance, factors, count, steps):
    """The factor of each difference over a distance, with the difference's sign."""
    others, zero = moved(pixels, distance), factors[0] - factors[0]
    for i in range(count):
        difference = others[i] - pixels[i]
        steps[i] = factors[i] if difference > zero else (-factors[i] if difference < zero else zero)


@inner_function()
def _add(pixels, distance, steps, count, totals):
    """Factor times |difference|, which is the step times the difference."""
    others = moved(pixels, distance)
    for i in range(count):
        totals[i] += steps[i] * (others[i] - pixels[i])
