"""The model: rays in; colours, temperatures and depths out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mrgs.baselines.thermonerf.networks import Field, Proposal, harmonics_of
from mrgs.baselines.thermonerf.rays import CameraRays, Rays, SceneFrame
from mrgs.baselines.thermonerf.sampling import (
    PROPOSALS,
    SAMPLES,
    Spacing,
    composite,
    even_edges,
    median_distance,
    render_weights,
    resample,
)
from mrgs.scene import RGB, Blend, Camera, Modality, Rendering

CHUNK_RAYS = 8_192
"""Rays that are rendered together, which takes about 170 MB of memory."""

ALL_ROWS = slice(None)


class Samples(NamedTuple):
    """Weights along the rays; edges are in normalised distance s.

    Attributes:
        edges: of the field's intervals, [R, S + 1].
        weights: of the field, [R, S].
        proposal_edges: of the proposal network's intervals, [R, P + 1].
        proposal_weights: of the proposal network, [R, P].
    """

    edges: Float[Tensor, "r e"]
    weights: Float[Tensor, "r s"]
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
        self,
        rays: Rays,
        rows: Mapping[Modality, slice],
        generator: torch.Generator | None = None,
    ) -> Traced:
        """Follow rays; differentiable in the parameters.

        Args:
            rays: any number.
            rows: of each modality that is wanted, the rays to follow for it.
            generator: of the random places of the samples, for training; None takes even ones.
        """
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
    ) -> tuple[Float[Tensor, "r s 3"], Float[Tensor, "r s"], Float[Tensor, "r e"]]:
        """Middles and lengths of intervals, and the distances of their edges, in radii."""
        distances = self._spacing.distance(edges)
        middles = 0.5 * (distances[:, 1:] + distances[:, :-1])
        positions = rays.origins[:, None] + middles[..., None] * rays.directions[:, None]
        return positions, distances[:, 1:] - distances[:, :-1], distances

    def _values(
        self,
        modality: Modality,
        weights: Float[Tensor, "r s"],
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
