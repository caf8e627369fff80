"""A Gaussian blur whose width is learned."""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from mrgs.method.cpu.separable import filter_plane
from mrgs.system import gpu

REACH = 4.0
"""Weights farther away than this many standard deviations are left out: 3e-4 of the centre's, and
less."""


def spread_points(plane: Float[Tensor, "h w"], sigma_px: Float[Tensor, ""]) -> Float[Tensor, "h w"]:
    """Blur by a Gaussian; what lies beyond the frame is left out of the mean. Differentiable once
    in both.

    Args:
        plane: float32 or float64.
        sigma_px: standard deviation in pixels.
    """
    if gpu.serves(plane):
        from mrgs.method.gpu import spread_points as spread_on_device

        return spread_on_device(plane, sigma_px, REACH)
    if plane.device.type != "cpu":
        return _spread_points(plane, sigma_px)
    result: Tensor = _Spread.apply(plane, sigma_px)
    return result


def _spread_points(plane: Tensor, sigma_px: Tensor) -> Tensor:
    """The blur in plain torch, for other devices; the kernels are tested against it."""
    down, across = (_means(size, sigma_px.to(plane.dtype), plane) for size in plane.shape)
    return down @ plane @ across.T


def _means(size: int, sigma_px: Tensor, plane: Tensor) -> Tensor:
    """The matrix that gives each place along an axis the mean of its neighbourhood: [size, size].

    As a matrix it does not depend on how far the weights reach, which the host would have to ask
    the device for.
    """
    places = torch.arange(size, dtype=plane.dtype, device=plane.device)
    distances = (places[:, None] - places).abs()
    weights = torch.exp(-0.5 * (distances / sigma_px) ** 2)
    weights = torch.where(distances <= torch.ceil(REACH * sigma_px.detach()), weights, 0)
    return weights / weights.sum(dim=1, keepdim=True)


class _Spread(torch.autograd.Function):
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
