"""A Gaussian blur of learned width as a separable filter, with its gradients."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba import prange
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from mrgs.kernels.jit import address, inner_function, parallel_kernel
from mrgs.kernels.require import require
from mrgs.method.camera_model.point_spread import REACH


def blur(plane: Float[Tensor, "h w"], sigma_px: Float[Tensor, ""]) -> Float[Tensor, "h w"]:
    """``mrgs.method.camera_model.point_spread.blur`` for float32 or float64 on the CPU;
    NotImplemented for a width that is not positive, or one for which the definition is as fast."""
    require("plane", plane, (None, None), (torch.float32, torch.float64))
    require("sigma_px", sigma_px, (), (torch.float32, torch.float64))
    if not 0 < REACH * sigma_px.item() < max(plane.shape):
        return NotImplemented
    result: Tensor = _Blur.apply(plane, sigma_px)
    return result


class _Blur(torch.autograd.Function):
    """With w the weights and w' their derivative by σ: the blur is (w ⊗ w) X / (w ⊗ w) 1."""

    @staticmethod
    def forward(ctx: Any, plane: Tensor, sigma_px: Tensor) -> Tensor:
        weights, slopes = _weights(sigma_px.item(), plane.dtype)
        totals = torch.outer(*(_within(size, weights) for size in plane.shape))
        blurred = _filter(plane, weights, weights) / totals
        ctx.save_for_backward(plane, blurred, totals, weights, slopes)
        return blurred

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        plane, blurred, totals, weights, slopes = ctx.saved_tensors
        gradient = gradient / totals
        change = _filter(plane, slopes, weights) + _filter(plane, weights, slopes)
        rows, columns = (_within(size, weights) for size in plane.shape)
        row_slopes, column_slopes = (_within(size, slopes) for size in plane.shape)
        change -= blurred * (torch.outer(row_slopes, columns) + torch.outer(rows, column_slopes))
        # Row by row, so that the order of the sum does not depend on the number of threads.
        by_sigma = (gradient * change).sum(dim=1).sum()
        return _filter(gradient, weights, weights), by_sigma


def _weights(sigma_px: float, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """exp(−x²/2σ²) and its derivative by σ, at x from −R to R."""
    radius = math.ceil(REACH * sigma_px)
    squares = torch.arange(-radius, radius + 1, dtype=torch.float64) ** 2
    weights = torch.exp(-0.5 * squares / sigma_px**2)
    return weights.to(dtype), (weights * squares / sigma_px**3).to(dtype)


def _within(size: int, weights: Tensor) -> Tensor:
    """Sum of the weights that lie inside the frame, by place, [size]."""
    radius = len(weights) // 2
    ones = nn.functional.pad(weights.new_ones(size), (radius, radius))
    return ones.unfold(0, len(weights), 1) @ weights


def _filter(plane: Tensor, down: Tensor, across: Tensor) -> Tensor:
    radius = len(down) // 2
    padded = nn.functional.pad(plane.detach(), (radius, radius, radius, radius))
    result = torch.empty_like(plane, memory_format=torch.contiguous_format)
    filter_plane(padded.numpy(), down.numpy(), across.numpy(), result.numpy())
    return result


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
