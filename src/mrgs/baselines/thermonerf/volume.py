"""Volume rendering of samples along rays."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def render_weights(
    densities: Float[Tensor, "r s"], lengths: Float[Tensor, "r s"]
) -> Float[Tensor, "r s"]:
    """How much each interval contributes to its ray: T_i (1 − exp(−σ_i δ_i)), Eq. 3 of NeRF
    (Mildenhall et al. 2020).

    Args:
        densities: σ, per unit of length.
        lengths: δ of the intervals, from the camera outwards.
    """
    depths = densities * lengths
    before = torch.cat([torch.zeros_like(depths[:, :1]), depths[:, :-1]], dim=1).cumsum(dim=1)
    return torch.exp(-before) * -torch.expm1(-depths)


def composite(
    weights: Float[Tensor, "r s"], values: Float[Tensor, "r s c"]
) -> Float[Tensor, "r c"]:
    """Weighted sums along the rays; what the weights lack to 1 counts as black."""
    return (weights[..., None] * values).sum(dim=1)


def median_distance(
    weights: Float[Tensor, "r s"], distances: Float[Tensor, "r s+1"]
) -> Float[Tensor, " r"]:
    """Where half of a ray's weight lies in front; a mean would be drawn far away by the little that
    never stops.

    Args:
        weights: of the intervals.
        distances: of their edges.
    """
    total = weights.cumsum(dim=1)
    half = 0.5 * total[:, -1:]
    place = torch.searchsorted(total, half).clamp(max=weights.shape[1] - 1)
    share = (half - total.gather(1, place)) / weights.gather(1, place).clamp(min=1e-12) + 1
    start, end = distances.gather(1, place), distances.gather(1, place + 1)
    return (start + (end - start) * share.clamp(0, 1))[:, 0]
