"""A 3 × 3 convolution of one plane on the CPU, where torch's own is made for many channels."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from mrgs.kernels.convolution.correlate import correlate, weights_gradient
from mrgs.kernels.require import require


def convolve(
    plane: Float[Tensor, "h w"], weights: Float[Tensor, "3 3"], bias: Float[Tensor, "1"]
) -> Float[Tensor, "h w"]:
    """``mrgs.method.losses.radiation.convolve`` for float32 or float64; differentiable once.

    Raises:
        ValueError: tensors of other sizes or types.
    """
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
