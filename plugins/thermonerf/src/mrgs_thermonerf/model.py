"""The model: rays in; colours, temperatures and depths out. Intervals along a ray are edges [R, S +
1] in normalised distance s, from 0 to 1."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mrgs.scene import RGB, Blend, Camera, Modality, Rendering
from mrgs_thermonerf.networks import Field, Proposal, harmonics_of
from mrgs_thermonerf.rays import CameraRays, Rays, SceneFrame

PerInterval: TypeAlias = Float[Tensor, "r s"]

CHUNK_RAYS = 8_192
"""Rays that are rendered together, which takes about 170 MB of memory."""

ALL_ROWS = slice(None)

PADDING = 0.01
"""Added to every weight, so that no part of a ray is left out for good (mip-NeRF, Section 3.2)."""

PROPOSALS, SAMPLES = 64, 32
"""Intervals of a ray in which the proposal network is evaluated, evenly spaced in s, and in which
the field is, placed by what that found."""


class Spacing:
    """The map between s in [0, 1] and distance t, linear for t much below ``middle``, linear in 1/t
    much above: t / (t + middle), normalised so that s is 0 at ``near`` and 1 at ``far``."""

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
    """Edges of ``count`` intervals; a generator shifts the inner ones at random."""
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
    """Edges of ``count`` intervals with about equal shares of the weights: inverse transform
    sampling. The edges of the weights' intervals ascend; the weights need not sum to 1, but are not
    negative. A generator shifts each ray's shares by one random part of a share."""
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


def render_weights(densities: PerInterval, lengths: PerInterval) -> PerInterval:
    """How much each interval contributes to its ray: T_i (1 − exp(−σ_i δ_i)), Eq. 3 of NeRF
    (Mildenhall et al. 2020), from the camera outwards."""
    depths = densities * lengths
    before = torch.cat([torch.zeros_like(depths[:, :1]), depths[:, :-1]], dim=1).cumsum(dim=1)
    return torch.exp(-before) * -torch.expm1(-depths)


def composite(weights: PerInterval, values: Float[Tensor, "r s c"]) -> Float[Tensor, "r c"]:
    """Weighted sums along the rays; what the weights lack to 1 counts as black."""
    return (weights[..., None] * values).sum(dim=1)


def median_distance(weights: PerInterval, distances: Float[Tensor, "r s+1"]) -> Float[Tensor, " r"]:
    """The distance with half of a ray's weight in front, from the distances of the intervals'
    edges; a mean would be drawn far away by the little that never stops."""
    total = weights.cumsum(dim=1)
    half = 0.5 * total[:, -1:]
    place = torch.searchsorted(total, half).clamp(max=weights.shape[1] - 1)
    share = (half - total.gather(1, place)) / weights.gather(1, place).clamp(min=1e-12) + 1
    start, end = distances.gather(1, place), distances.gather(1, place + 1)
    return (start + (end - start) * share.clamp(0, 1))[:, 0]


class Samples(NamedTuple):
    """Weights along the rays; edges are in normalised distance s.

    Attributes:
        edges: of the field's intervals, [R, S + 1].
        weights: of the field, [R, S].
        proposal_edges: of the proposal network's intervals, [R, P + 1].
        proposal_weights: of the proposal network, [R, P].
    """

    edges: Float[Tensor, "r e"]
    weights: PerInterval
    proposal_edges: Float[Tensor, "r q"]
    proposal_weights: Float[Tensor, "r p"]


class Traced(NamedTuple):
    """Values, depths and weights of traced rays.

    Attributes:
        values: colours or normalised temperatures of the rays that were asked for them, by
            modality, [R', C].
        depth: z-depth in scene units up to which half of the weight lies, times alpha, [R]; without
            gradient.
        alpha: sum of the weights, [R].
        samples: the weights.
    """

    values: dict[Modality, Float[Tensor, "_ c"]]
    depth: Float[Tensor, " r"]
    alpha: Float[Tensor, " r"]
    samples: Samples


class ThermoNerf(nn.Module):
    """One density, one colour head, one temperature head (Hassan et al., ThermoNeRF)."""

    def __init__(self, frame: SceneFrame) -> None:
        super().__init__()
        self.frame = frame
        self.field = Field()
        self.proposal = Proposal()
        self._spacing = Spacing(frame.near, frame.middle, frame.far)

    def trace(
        self, rays: Rays, rows: Mapping[Modality, slice], generator: torch.Generator | None = None
    ) -> Traced:
        """Follow any number of rays, of each modality in ``rows`` those for it; differentiable in
        the parameters. The generator places the samples at random, for training; None takes even
        ones."""
        count = len(rays.origins)
        proposal_edges = even_edges(count, PROPOSALS, generator, rays.origins).contiguous()
        positions, lengths, _ = self._intervals(rays, proposal_edges)
        densities = self.proposal.density(positions.flatten(0, 1)).view(lengths.shape)
        proposal_weights = render_weights(densities, lengths)

        edges = resample(proposal_edges, proposal_weights.detach(), SAMPLES, generator)
        positions, lengths, distances = self._intervals(rays, edges)
        densities, features = self.field.density(positions.flatten(0, 1))
        features = features.view(*lengths.shape, -1)
        weights = render_weights(densities.view(lengths.shape), lengths)
        alphas = weights.sum(dim=1)
        depth = (
            median_distance(weights.detach(), distances)
            * rays.cosines
            * (self.frame.radius * alphas.detach())
        )
        values = {
            modality: self._values(modality, weights[some], features[some], rays.directions[some])
            for modality, some in rows.items()
        }
        samples = Samples(edges, weights, proposal_edges, proposal_weights)
        return Traced(values, depth, alphas, samples)

    def render(self, cameras: Mapping[Modality, Camera]) -> Rendering:
        """Render the modalities that have a camera, without gradients; one pass renders all if the
        cameras coincide."""
        used = list(cameras.values())
        is_shared = bool(used) and all(camera.coincides_with(used[0]) for camera in used)
        passes = [list(cameras)] if is_shared else [[modality] for modality in cameras]
        blends: dict[Modality, Blend] = {}
        for modalities in passes:
            blends |= self._images(cameras[modalities[0]], modalities)
        return Rendering(blends)

    @torch.no_grad()
    def _images(self, camera: Camera, modalities: list[Modality]) -> dict[Modality, Blend]:
        """The modalities' images, which have one depth and one alpha."""
        rays = CameraRays([camera], self.frame)
        rows = dict.fromkeys(modalities, ALL_ROWS)
        parts = [
            self.trace(rays.through(pixels), rows)
            for pixels in torch.arange(len(rays)).split(CHUNK_RAYS)
        ]

        def image(values: list[Tensor]) -> Tensor:
            return torch.cat(values).reshape(camera.height, camera.width, *values[0].shape[1:])

        depth, alpha = image([part.depth for part in parts]), image([part.alpha for part in parts])
        return {
            modality: Blend(image([part.values[modality] for part in parts]), depth, alpha)
            for modality in modalities
        }

    def _intervals(
        self, rays: Rays, edges: Float[Tensor, "r e"]
    ) -> tuple[Float[Tensor, "r s 3"], PerInterval, Float[Tensor, "r e"]]:
        """Middles and lengths of intervals, and the distances of their edges, in radii."""
        distances = self._spacing.distance(edges)
        middles = 0.5 * (distances[:, 1:] + distances[:, :-1])
        positions = rays.origins[:, None] + middles[..., None] * rays.directions[:, None]
        return positions, distances[:, 1:] - distances[:, :-1], distances

    def _values(
        self,
        modality: Modality,
        weights: PerInterval,
        features: Float[Tensor, "r s f"],
        directions: Float[Tensor, "r 3"],
    ) -> Float[Tensor, "r c"]:
        """Colours as seen along the rays, or temperatures."""
        if modality == RGB:
            harmonics = harmonics_of(directions)[:, None].expand(-1, weights.shape[1], -1)
            values = self.field.color(features.flatten(0, 1), harmonics.flatten(0, 1))
        else:
            values = self.field.temperature(features.flatten(0, 1))
        return composite(weights, values.view(*weights.shape, modality.channels))
