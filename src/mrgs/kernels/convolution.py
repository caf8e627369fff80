"""A 3 × 3 convolution of one plane, where torch's own is made for many channels."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from numba import prange
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from mrgs.kernels.jit import address, inner_function, parallel_kernel, reordering_inner_function
from mrgs.kernels.require import require


def convolve(
    plane: Float[Tensor, "h w"], weights: Float[Tensor, "3 3"], bias: Float[Tensor, "1"]
) -> Float[Tensor, "h w"]:
    """``mrgs.method.losses.radiation.convolve`` for float32 or float64; differentiable once.
    ValueError for tensors of other sizes or types."""
    require("plane", plane, (None, None), (torch.float32, torch.float64))
    require("weights", weights, (3, 3), (plane.dtype,))
    result: Tensor = _Convolution.apply(plane, weights)
    return result + bias


class _Convolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plane: Tensor, weights: Tensor) -> Tensor:
        padded = _pad(plane)
        ctx.save_for_backward(padded, weights)
        return _correlate(padded, weights)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        padded, weights = ctx.saved_tensors
        sums = torch.empty(len(gradient), 9, dtype=torch.float64)
        weights_gradient(padded.numpy(), gradient.contiguous().numpy(), sums.numpy())
        grad_weights = sums.sum(dim=0).view(3, 3).to(weights.dtype)
        return _correlate(_pad(gradient), weights.flip(0, 1)), grad_weights


def _pad(plane: Tensor) -> Tensor:
    return nn.functional.pad(plane.detach(), (1, 1, 1, 1))


def _correlate(padded: Tensor, weights: Tensor) -> Tensor:
    result = padded.new_empty(padded.shape[0] - 2, padded.shape[1] - 2)
    correlate(padded.numpy(), weights.detach().flatten().numpy(), result.numpy())
    return result


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
    """Each row's share of the gradient with respect to the nine weights, double precision, [H, 9],
    from the gradient of the result, [H, W]."""
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


def convolve_on_gpu(
    plane: Float[Tensor, "h w"], weights: Float[Tensor, "3 3"], bias: Float[Tensor, "1"]
) -> Float[Tensor, "h w"]:
    """``mrgs.method.losses.radiation.convolve`` as a product, which does not depend on torch's
    leave to convolve with ten bits of mantissa."""
    neighbourhoods = nn.functional.unfold(plane[None, None], kernel_size=3, padding=1)[0]
    return (weights.reshape(1, 9) @ neighbourhoods).view(plane.shape) + bias
