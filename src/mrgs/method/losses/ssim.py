"""Structural similarity from local Gaussian windows: SSIM as in 3DGS, and the paper's S-SSIM."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor, nn

Planes: TypeAlias = Float[Tensor, "c h w"]

RADIUS_PX = 5
"""The window has 11 × 11 pixels."""

SIGMA_PX = 1.5

K1, K2 = 0.01, 0.03
"""SSIM's stabilisers: C1 = (K1 · data range)², C2 = (K2 · data range)²."""

STRUCTURE_C2 = 9e-4
"""C2 of S-SSIM, that of SSIM at a data range of 1."""


def _window_weights() -> Float[Tensor, "11"]:
    offsets = torch.arange(-RADIUS_PX, RADIUS_PX + 1, dtype=torch.float64)
    weights = torch.exp(-0.5 * (offsets / SIGMA_PX) ** 2)
    return weights / weights.sum()


WEIGHTS = _window_weights()
"""The window along one axis, float64; the 2D window is its outer product with itself."""


def window_mean(planes: Planes) -> Planes:
    """Mean of each pixel's 11 × 11 neighbourhood, Gaussian weights (σ = 1.5 px), zeros beyond the
    border (as 3DGS)."""
    for axis, padding in ((1, (0, 0, RADIUS_PX, RADIUS_PX)), (2, (RADIUS_PX, RADIUS_PX))):
        padded, size = nn.functional.pad(planes, padding), planes.shape[axis]
        planes = torch.zeros_like(planes)
        for tap, weight in enumerate(WEIGHTS.tolist()):
            planes = planes.add(padded.narrow(axis, tap, size), alpha=weight)
    return planes


class LocalStatistics(NamedTuple):
    """Local moments of two images, each [C, H, W]."""

    mean_x: Planes
    mean_y: Planes
    variance_x: Planes
    variance_y: Planes
    covariance: Planes


def local_statistics(x: Planes, y: Planes) -> LocalStatistics:
    """Means, variances and covariance of both images under the window."""
    mean_x, square_x, product = window_mean(torch.cat([x, x * x, x * y])).chunk(3)
    # Apart, because a target asks for no backward pass.
    mean_y, square_y = window_mean(torch.cat([y, y * y])).chunk(2)
    return LocalStatistics(
        mean_x=mean_x,
        mean_y=mean_y,
        variance_x=square_x - mean_x * mean_x,
        variance_y=square_y - mean_y * mean_y,
        covariance=product - mean_x * mean_y,
    )


def ssim_map(x: Planes, y: Planes, data_range: float | Float[Tensor, ""] = 1.0) -> Planes:
    """SSIM of every pixel (Wang et al. 2004).

    3DGS takes the mean of the whole map. torchmetrics up to 1.4.1 takes that of its interior,
    ``RADIUS_PX`` pixels away from the border, where both maps agree; later releases take the whole
    map, but reflect the images beyond the border.

    The image that carries gradients is put first. ``data_range`` is the width of the range of
    values: 1 in the 3DGS family, by default that of the two images in torchmetrics.
    """
    c1, c2 = (K1 * data_range) ** 2, (K2 * data_range) ** 2
    local = local_statistics(x, y)
    cross = local.mean_x * local.mean_y
    luminance = (2 * cross + c1) / (local.mean_x.square() + local.mean_y.square() + c1)
    return luminance * (2 * local.covariance + c2) / (local.variance_x + local.variance_y + c2)


def structural_similarity(x: Planes, y: Planes) -> Planes:
    """S-SSIM of every pixel: the structure term alone, blind to brightness.

    Eq. 14 (S-SSIM), Sec. Uncertainty-aware S-SSIM: 2 C_xy / (C_x + C_y). 9e-4 is added to numerator
    and denominator, so that two flat windows are alike.
    """
    local, c2 = local_statistics(x, y), STRUCTURE_C2
    return (2 * local.covariance + c2) / (local.variance_x + local.variance_y + c2)
