"""A Gaussian blur whose width is learned."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.system.operation import operation

REACH = 4.0
"""Weights farther away than this many standard deviations are left out: 3e-4 of the centre's, and
less."""


@operation
def blur(plane: Float[Tensor, "h w"], sigma_px: Float[Tensor, ""]) -> Float[Tensor, "h w"]:
    """Blur an image by a Gaussian; what lies beyond the frame is left out of the mean.

    Differentiable once in both arguments.

    Args:
        plane: the image.
        sigma_px: standard deviation in pixels.
    """
    down, across = (_means(size, sigma_px.to(plane.dtype), plane) for size in plane.shape)
    return down @ plane @ across.T


def _means(
    size: int, sigma_px: Float[Tensor, ""], plane: Float[Tensor, "h w"]
) -> Float[Tensor, "{size} {size}"]:
    """The matrix that gives each pixel along an axis the mean of its neighbourhood.

    As a matrix it does not depend on how far the weights reach, which the host would have to ask
    the device for.
    """
    pixels = torch.arange(size, dtype=plane.dtype, device=plane.device)
    distances = (pixels[:, None] - pixels).abs()
    weights = torch.exp(-0.5 * (distances / sigma_px) ** 2)
    weights = torch.where(distances <= torch.ceil(REACH * sigma_px.detach()), weights, 0)
    return weights / weights.sum(dim=1, keepdim=True)
