"""L_dist, not in the paper: what blocks the light of a pixel lies in one surface."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from mrgs.rasterizer.inverse_depth import InverseDepths

BEGINS = 0.3
"""Share of the steps before L_dist, which would hold on to what was not yet seen through:
docs/decisions."""

EVERY = 8
"""Steps from one use of L_dist to the next, which counts for all of them: docs/decisions."""

PIXEL_SIZE = 2
"""Side of a pixel in which L_dist is computed, in pixels of the photo."""

LEAST_SPREAD = 1e-3
"""Relative spread of the depths below which a surface is thin enough."""

LARGE_SPREAD = 0.1
"""Relative spread from which on a pixel is taken to see several objects, as along an outline, and
hardly counts more the farther apart they are."""

LEAST_WEIGHT = 0.05
"""Σ w below which a pixel hardly shows a surface."""

LEAST_NEARNESS = 1e-6


def distortion_loss(depths: InverseDepths) -> Float[Tensor, ""]:
    """L_dist: how far apart, relative to their distance, the surfaces are that one pixel sees.

    The mean over the pixels of s / (1 + s / 0.1) with the spread s = √(V / ρ̄² + 0.001²), where V =
    Σw Σwρ² − (Σwρ)² = ½ Σ_ij w_i w_j (ρ_i − ρ_j)² is the variance of the inverse depths ρ at which
    the pixel's ray meets its Gaussians, and ρ̄ their mean, without gradient. Mip-NeRF 360 (Barron
    et al. 2022) and 2DGS (Huang et al. 2024) have such a loss of the depths of samples and of
    discs. A plane costs nothing, whatever the angle at which it is seen; a wall that is a slab of
    half-transparent Gaussians does, and so does what floats before it. A pixel that rightly sees
    two objects counts little.

    Args:
        depths: of one layer, by one camera.
    """
    variance = (depths.weight * depths.squares - depths.sum**2).clamp_min(0)
    mean = (depths.sum / depths.weight.clamp_min(LEAST_WEIGHT)).detach()
    relative = variance / mean.clamp_min(LEAST_NEARNESS) ** 2
    spread = (relative + LEAST_SPREAD**2).sqrt()
    return (spread / (1 + spread / LARGE_SPREAD)).mean()
