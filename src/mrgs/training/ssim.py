"""Structural similarity from local Gaussian windows: SSIM as 3DGS has it, and the paper's S-SSIM."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numba import njit, prange
from torch import Tensor, nn

RADIUS_PX = 5
"""The window has 11 × 11 pixels."""

SIGMA_PX = 1.5

K1, K2 = 0.01, 0.03
"""SSIM's stabilisers: C1 = (K1 · data range)², C2 = (K2 · data range)²."""

STRUCTURE_C2 = 9e-4
"""C2 of S-SSIM, that of SSIM at a data range of 1."""


def _window_weights() -> np.ndarray:
    offsets = np.arange(-RADIUS_PX, RADIUS_PX + 1)
    weights = np.exp(-0.5 * (offsets / SIGMA_PX) ** 2)
    return weights / weights.sum()


WEIGHTS = _window_weights()
"""The window along one axis; the two-dimensional window is its outer product with itself."""


def window_mean(planes: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
    """Mean of each pixel's 11 × 11 neighbourhood, Gaussian weights with σ = 1.5 px, zeros beyond the border (as 3DGS).

    float32 or float64; differentiable any number of times.
    """
    result: Tensor = _WindowMean.apply(planes)
    return result


class _WindowMean(torch.autograd.Function):
    """The window is symmetric and the padding is zero, so the filter is its own adjoint."""

    @staticmethod
    def forward(ctx: Any, planes: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
        if planes.device.type != "cpu":
            return _filter_on_device(planes)
        source = planes.detach().contiguous()
        result = torch.empty_like(source)
        _filter_planes(source.numpy(), WEIGHTS.astype(source.numpy().dtype), result.numpy())
        return result

    @staticmethod
    def backward(ctx: Any, gradient: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
        return window_mean(gradient)


def _filter_on_device(planes: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
    """The same filter as two convolutions, for accelerators."""
    weights = torch.from_numpy(WEIGHTS).to(planes)
    rows = nn.functional.conv2d(planes[:, None], weights.view(1, 1, -1, 1), padding=(RADIUS_PX, 0))
    return nn.functional.conv2d(rows, weights.view(1, 1, 1, -1), padding=(0, RADIUS_PX))[:, 0]


@njit(parallel=True, cache=True, error_model="numpy")
def _filter_planes(planes, weights, result):  # type: ignore[no-untyped-def]  # numpy arrays [C, H, W], [11], [C, H, W]
    """Down the columns into a padded row, then along that row: each output row is one task, and nothing is shared."""
    count, height, width = planes.shape
    taps = weights.size
    radius = taps // 2
    for task in prange(count * height):
        plane, row = planes[task // height], task % height
        padded = np.zeros(width + 2 * radius, planes.dtype)
        inner = padded[radius : radius + width]
        for tap in range(max(0, radius - row), min(taps, height + radius - row)):
            source, weight = plane[row + tap - radius], weights[tap]
            for column in range(width):
                inner[column] += weight * source[column]
        target = result[task // height, row]
        target[:] = 0
        for tap in range(taps):
            source, weight = padded[tap : tap + width], weights[tap]
            for column in range(width):
                target[column] += weight * source[column]


class LocalStatistics(NamedTuple):
    """Local moments of two images, each [C, H, W]."""

    mean_x: Float[Tensor, "c h w"]
    mean_y: Float[Tensor, "c h w"]
    variance_x: Float[Tensor, "c h w"]
    variance_y: Float[Tensor, "c h w"]
    covariance: Float[Tensor, "c h w"]


def local_statistics(x: Float[Tensor, "c h w"], y: Float[Tensor, "c h w"]) -> LocalStatistics:
    """Means, variances and covariance of both images under the window."""
    mean_x, square_x, product = window_mean(torch.cat([x, x * x, x * y])).chunk(3)
    mean_y, square_y = window_mean(torch.cat([y, y * y])).chunk(2)  # apart: a target asks for no backward pass
    return LocalStatistics(
        mean_x=mean_x,
        mean_y=mean_y,
        variance_x=square_x - mean_x * mean_x,
        variance_y=square_y - mean_y * mean_y,
        covariance=product - mean_x * mean_y,
    )


def ssim_map(
    x: Float[Tensor, "c h w"], y: Float[Tensor, "c h w"], data_range: float | Float[Tensor, ""] = 1.0
) -> Float[Tensor, "c h w"]:
    """SSIM of every pixel (Wang et al. 2004).

    3DGS takes the mean of the whole map. torchmetrics up to 1.4.1 takes that of its interior, ``RADIUS_PX`` pixels away
    from the border, where both maps agree; later releases take the whole map, but reflect the images beyond the border.

    Args:
        x: an image; put the one that carries gradients first.
        y: the image to compare with.
        data_range: the width of the range of values; 1 in the 3DGS family, by default that of the two images in
            torchmetrics.
    """
    c1, c2 = (K1 * data_range) ** 2, (K2 * data_range) ** 2
    local = local_statistics(x, y)
    cross = local.mean_x * local.mean_y
    luminance = (2 * cross + c1) / (local.mean_x.square() + local.mean_y.square() + c1)
    return luminance * (2 * local.covariance + c2) / (local.variance_x + local.variance_y + c2)


def structural_similarity(x: Float[Tensor, "c h w"], y: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
    """S-SSIM of every pixel: the structure term alone, blind to brightness.

    Eq. 14 (S-SSIM), Sec. Uncertainty-aware S-SSIM: 2 C_xy / (C_x + C_y). 9e-4 is added to numerator and denominator,
    so that two flat windows are alike.
    """
    local = local_statistics(x, y)
    return (2 * local.covariance + STRUCTURE_C2) / (local.variance_x + local.variance_y + STRUCTURE_C2)
