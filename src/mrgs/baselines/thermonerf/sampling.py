"""Places along a ray at which the field is evaluated, and volume rendering of what it returns.
Intervals are edges [R, S + 1] in normalised distance s, from 0 to 1."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

PADDING = 0.01
"""Added to every weight, so that no part of a ray is left out for good (mip-NeRF, Section 3.2)."""

PROPOSALS, SAMPLES = 64, 32
"""Intervals of a ray in which the proposal network is evaluated, evenly spaced in s, and in which
the field is, placed by what that found."""


class Spacing:
    """The map between s in [0, 1] and distance t: linear for t much below ``middle``, linear in 1/t
    much above.

    t / (t + middle) is normalised so that s runs from 0 at ``near`` to 1 at ``far``.
    """

    def __init__(self, near: float, middle: float, far: float) -> None:
        self._middle = middle
        self._first = near / (near + middle)
        self._last = far / (far + middle)

    def distance(self, s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """Distances of normalised distances."""
        place = self._first + s * (self._last - self._first)
        return self._middle * place / (1 - place)


def even_edges(
    rays: int, count: int, generator: torch.Generator | None, like: Float[Tensor, "..."]
) -> Float[Tensor, "{rays} {count}+1"]:
    """Edges of ``count`` intervals; a generator shifts the inner ones at random, so that training
    covers every distance."""
    edges = torch.linspace(0, 1, count + 1, dtype=like.dtype).expand(rays, -1)
    if generator is None:
        return edges
    shift = (torch.rand(rays, 1, generator=generator).to(like.dtype) - 0.5) / count
    return torch.cat([edges[:, :1], edges[:, 1:-1] + shift, edges[:, -1:]], dim=1)


def resample(
    edges: Float[Tensor, "r q"],
    weights: Float[Tensor, "r p"],
    count: int,
    generator: torch.Generator | None,
) -> Float[Tensor, "r {count}+1"]:
    """Edges of ``count`` intervals that hold about equal shares of the weights: inverse transform
    sampling.

    Args:
        edges: of the intervals that the weights belong to, ascending.
        weights: not negative; they need not sum to 1.
        count: intervals wanted.
        generator: shifts each ray's shares by one random part of a share; None takes them evenly.
    """
    weights = weights + PADDING / weights.shape[1]
    cdf = (weights / weights.sum(dim=1, keepdim=True)).cumsum(dim=1)
    cdf = torch.cat(
        [torch.zeros_like(cdf[:, :1]), cdf[:, :-1].clamp(max=1), torch.ones_like(cdf[:, :1])], dim=1
    )
    shares = even_edges(len(edges), count, generator, edges).contiguous()
    above = torch.searchsorted(cdf, shares, right=True).clamp(1, weights.shape[1])
    low, high = cdf.gather(1, above - 1), cdf.gather(1, above)
    start, end = edges.gather(1, above - 1), edges.gather(1, above)
    return start + (end - start) * ((shares - low) / (high - low)).clamp(0, 1)


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
