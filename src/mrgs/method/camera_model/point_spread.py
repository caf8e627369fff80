"""What a thermal lens and its detector do to an image: a Gaussian blur whose width is learned."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mrgs.system.operation import operation

REACH = 4.0
"""Weights beyond this many standard deviations, 3e-4 of the centre's or less, are left out."""

INITIAL_SIGMA_PX = 0.8
SMALLEST_SIGMA_PX = 0.2
"""Smallest width in pixels of a rendering, which may be coarser than the photo."""

SMALLEST_LEARNED_PX = 0.3
"""Smallest width in pixels of the photo. It moves a hundredth of what a pixel shows to its
neighbours; a much smaller width has no gradient, so that it would never grow again."""


class PointSpread(nn.Module):
    """A Gaussian point spread whose width is learned."""

    def __init__(self) -> None:
        super().__init__()
        self.log_sigma = nn.Parameter(torch.tensor(math.log(INITIAL_SIGMA_PX)))

    @property
    def sigma_px(self) -> Float[Tensor, ""]:
        """Standard deviation in pixels of the thermal image."""
        return self.log_sigma.exp()

    def forward(
        self, image: Float[Tensor, "h w 1"], pixel_size: float = 1.0
    ) -> Float[Tensor, "h w 1"]:
        """The image as lens and detector spread it; its pixel size in pixels of the photos."""
        sigma = (self.sigma_px / pixel_size).clamp_min(SMALLEST_SIGMA_PX)
        return blur(image[:, :, 0], sigma)[:, :, None]

    @torch.no_grad()
    def limit(self) -> None:
        """Widen the spread to ``SMALLEST_LEARNED_PX`` if it is narrower."""
        self.log_sigma.clamp_(min=math.log(SMALLEST_LEARNED_PX))


@operation
def blur(plane: Float[Tensor, "h w"], sigma_px: Float[Tensor, ""]) -> Float[Tensor, "h w"]:
    """Blur an image by a Gaussian of this standard deviation; what is beyond the frame is left out
    of the mean. Differentiable once in both arguments."""
    down, across = (_means(size, sigma_px.to(plane.dtype), plane) for size in plane.shape)
    return down @ plane @ across.T


def _means(
    size: int, sigma_px: Float[Tensor, ""], plane: Float[Tensor, "h w"]
) -> Float[Tensor, "{size} {size}"]:
    """The matrix that gives each pixel along an axis the mean of its neighbourhood. It covers the
    whole axis: how far the weights reach, the host would have to ask the device."""
    pixels = torch.arange(size, dtype=plane.dtype, device=plane.device)
    distances = (pixels[:, None] - pixels).abs()
    weights = torch.exp(-0.5 * (distances / sigma_px) ** 2)
    weights = torch.where(distances <= torch.ceil(REACH * sigma_px.detach()), weights, 0)
    return weights / weights.sum(dim=1, keepdim=True)
