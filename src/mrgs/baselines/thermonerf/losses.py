"""What training minimises: squared errors of both modalities, and two terms on the weights along
the rays."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.system.limits import MOST_WEIGHT, require_within


@dataclass(frozen=True)
class NerfLossConfig:
    """Weights of the terms; both squared errors have the weight 1.

    Attributes:
        interlevel: of the term that teaches the proposal network.
        distortion: of the term that pulls a ray's weights together.
    """

    interlevel: float = 1.0
    distortion: float = 0.002

    def __post_init__(self) -> None:
        require_within(self, ("interlevel", "distortion"), 0, MOST_WEIGHT)


def squared_error(
    rendered: Float[Tensor, "r c"], target: Float[Tensor, "r c"], valid: Bool[Tensor, " r"] | None
) -> Float[Tensor, ""]:
    """Mean squared error over the valid rays; 0 if none is."""
    error = (rendered - target).square().mean(dim=1)
    if valid is None:
        return error.mean()
    return torch.where(valid, error, 0).sum() / valid.sum().clamp(min=1)


def interlevel_loss(
    edges: Float[Tensor, "r e"],
    weights: Float[Tensor, "r s"],
    proposal_edges: Float[Tensor, "r q"],
    proposal_weights: Float[Tensor, "r p"],
) -> Float[Tensor, ""]:
    """How far the field's weights stick out of what the proposals allow: Eq. 13 of mip-NeRF 360,
    mean over the rays.

    An interval's bound is the sum of the proposals that it touches (Eq. 12). The field's weights
    are targets: no gradient reaches them.
    """
    edges, weights = edges.detach().contiguous(), weights.detach()
    total = proposal_weights.cumsum(dim=1)
    total = torch.cat([torch.zeros_like(total[:, :1]), total], dim=1)
    last = proposal_weights.shape[1]
    first_touched = (torch.searchsorted(proposal_edges, edges, right=True)[:, :-1] - 1).clamp(
        0, last
    )
    behind_touched = torch.searchsorted(proposal_edges, edges, right=False)[:, 1:].clamp(0, last)
    bound = total.gather(1, behind_touched) - total.gather(1, first_touched)
    excess = (weights - bound).clamp(min=0)
    return (excess.square() / (weights + 1e-7)).sum(dim=1).mean()


def distortion_loss(
    edges: Float[Tensor, "r e"], weights: Float[Tensor, "r s"]
) -> Float[Tensor, ""]:
    """Σ_ij w_i w_j |m_i − m_j| + ⅓ Σ_i w_i² (length of i): Eq. 15 of mip-NeRF 360, mean over the
    rays.

    The midpoints m ascend, so the double sum is one pass over sums of what lies before.
    """
    middles = 0.5 * (edges[:, 1:] + edges[:, :-1])
    lengths = edges[:, 1:] - edges[:, :-1]
    moments = weights * middles
    weight_before = weights.cumsum(dim=1) - weights
    moment_before = moments.cumsum(dim=1) - moments
    between = 2 * (weights * (middles * weight_before - moment_before)).sum(dim=1)
    within = (weights.square() * lengths).sum(dim=1) / 3
    return (between + within).mean()
