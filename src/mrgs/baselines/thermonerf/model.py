"""The model: rays in; colours, temperatures and depths out."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mrgs.baselines.thermonerf.config import ThermoNerfConfig
from mrgs.baselines.thermonerf.field import Field, Proposal, harmonics_of
from mrgs.baselines.thermonerf.frame import Frame
from mrgs.baselines.thermonerf.rays import CameraRays, Rays
from mrgs.baselines.thermonerf.sampling import Spacing, even_edges, resample
from mrgs.baselines.thermonerf.volume import composite, median_distance, render_weights
from mrgs.render import Rendering
from mrgs.scene import Camera

CHUNK_RAYS = 8_192
"""Rays that are rendered together, which takes about 170 MB of memory."""

NO_ROWS = slice(0, 0)
ALL_ROWS = slice(None)


class Samples(NamedTuple):
    """What the weights along the rays are; edges are in normalised distance s.

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
    """What rays see.

    Attributes:
        rgb: colours of the rays that were asked for it, [R', 3].
        thermal: normalised temperatures, [R'', 1].
        depth: z-depth in scene units up to which half of the weight lies, times alpha, [R]; without
            gradient.
        alpha: sum of the weights, [R].
        samples: the weights.
    """

    rgb: Float[Tensor, "r1 3"]
    thermal: Float[Tensor, "r2 1"]
    depth: Float[Tensor, " r"]
    alpha: Float[Tensor, " r"]
    samples: Samples


class ThermoNerf(nn.Module):
    """One density, one colour head, one temperature head (Hassan et al., ThermoNeRF).

    Args:
        config: of the run.
        frame: of the scene.
    """

    def __init__(self, config: ThermoNerfConfig, frame: Frame) -> None:
        super().__init__()
        self.frame = frame
        self.field = Field(config.field)
        self.proposal = Proposal(config.proposal)
        self._sampling = config.sampling
        self._spacing = Spacing(frame.near, frame.middle, frame.far)

    def trace(
        self,
        rays: Rays,
        rgb_rows: slice,
        thermal_rows: slice,
        generator: torch.Generator | None = None,
    ) -> Traced:
        """Follow rays; differentiable in the parameters.

        Args:
            rays: any number.
            rgb_rows: the rays whose colour is wanted.
            thermal_rows: the rays whose temperature is wanted.
            generator: of the random places of the samples, for training; None takes even ones.
        """
        proposal_edges = even_edges(
            len(rays.origins), self._sampling.proposal, generator, rays.origins
        ).contiguous()
        positions, lengths, _ = self._intervals(rays, proposal_edges)
        densities = self.proposal.density(positions.flatten(0, 1)).view(lengths.shape)
        proposal_weights = render_weights(densities, lengths)

        edges = resample(proposal_edges, proposal_weights.detach(), self._sampling.field, generator)
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
        return Traced(
            self._color(weights[rgb_rows], features[rgb_rows], rays.directions[rgb_rows]),
            self._temperature(weights[thermal_rows], features[thermal_rows]),
            depth,
            alphas,
            Samples(edges, weights, proposal_edges, proposal_weights),
        )

    def render(self, rgb_camera: Camera | None, thermal_camera: Camera | None) -> Rendering:
        """Render the modalities that have a camera, without gradients; one pass serves both if the
        cameras coincide."""
        if (
            rgb_camera is not None
            and thermal_camera is not None
            and rgb_camera.coincides_with(thermal_camera)
        ):
            rgb, thermal, depth, alpha = self._image(rgb_camera, ALL_ROWS, ALL_ROWS)
            return Rendering(rgb, depth, thermal, depth, alpha, alpha)
        rendering = Rendering()
        if rgb_camera is not None:
            rgb, _, depth, alpha = self._image(rgb_camera, ALL_ROWS, NO_ROWS)
            rendering = rendering._replace(rgb=rgb, depth_rgb=depth, alpha_rgb=alpha)
        if thermal_camera is not None:
            _, thermal, depth, alpha = self._image(thermal_camera, NO_ROWS, ALL_ROWS)
            rendering = rendering._replace(
                thermal=thermal, depth_thermal=depth, alpha_thermal=alpha
            )
        return rendering

    @torch.no_grad()
    def _image(self, camera: Camera, rgb_rows: slice, thermal_rows: slice) -> list[Tensor]:
        """Colours, temperatures, z-depths and alphas of a camera's pixels, each [H, W, ...]."""
        rays = CameraRays([camera], self.frame)
        parts = []
        for pixels in torch.arange(len(rays)).split(CHUNK_RAYS):
            traced = self.trace(rays.through(pixels), rgb_rows, thermal_rows)
            parts.append((traced.rgb, traced.thermal, traced.depth, traced.alpha))
        images = [torch.cat(part) for part in zip(*parts, strict=True)]
        return [
            image.reshape(camera.height, -1, *image.shape[1:]) if len(image) else image
            for image in images
        ]

    def _intervals(
        self, rays: Rays, edges: Float[Tensor, "r e"]
    ) -> tuple[Float[Tensor, "r s 3"], Float[Tensor, "r s"], Float[Tensor, "r e"]]:
        """Middles and lengths of intervals, and the distances of their edges, in radii."""
        distances = self._spacing.distance(edges)
        middles = 0.5 * (distances[:, 1:] + distances[:, :-1])
        positions = rays.origins[:, None] + middles[..., None] * rays.directions[:, None]
        return positions, distances[:, 1:] - distances[:, :-1], distances

    def _color(
        self,
        weights: Float[Tensor, "r s"],
        features: Float[Tensor, "r s f"],
        directions: Float[Tensor, "r 3"],
    ) -> Float[Tensor, "r 3"]:
        harmonics = harmonics_of(directions)[:, None].expand(-1, weights.shape[1], -1)
        colors = self.field.color(features.flatten(0, 1), harmonics.flatten(0, 1))
        return composite(weights, colors.view(*weights.shape, 3))

    def _temperature(
        self, weights: Float[Tensor, "r s"], features: Float[Tensor, "r s f"]
    ) -> Float[Tensor, "r 1"]:
        temperatures = self.field.temperature(features.flatten(0, 1))
        return composite(weights, temperatures.view(*weights.shape, 1))
