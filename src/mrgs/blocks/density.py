"""Density control within a part of a scene: what lies outside stays as it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.blocks.region import Region, Ring, ScenePlane
from mrgs.method.density import (
    DensityStep,
    DensityUpdate,
    Strategy,
    StrategyState,
)
from mrgs.method.optimizer import GaussianOptimizer
from mrgs.render import ScreenPoints
from mrgs.scene import Gaussians, SceneBounds

EXTENT = 3.0
"""A Gaussian reaches so many of its largest standard deviations."""


@dataclass(frozen=True)
class Part:
    """A part of a scene: what lies in a region of its plane, without the background.

    Attributes:
        plane: of the scene.
        region: in the plane.
        counted: the region of which photos tell the part; the same or a larger one.
        reach: of the scene.
        extent: of a Gaussian, in its largest standard deviations.
    """

    plane: ScenePlane
    region: Region | Ring
    counted: Region | Ring
    reach: SceneBounds
    extent: float = EXTENT

    def contains(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Whether points of the world belong to it."""
        inside = self.region.contains(self.plane.coordinates(points))
        return inside & ~self.reach.is_background(points)

    @torch.no_grad()
    def holds(self, gaussians: Gaussians) -> Bool[Tensor, " n"]:
        """Which Gaussians belong to it and reach no farther than photos count."""
        places = self.plane.coordinates(gaussians.means)
        seen = self.counted.contains(places, self.extent * gaussians.scales.amax(dim=1))
        return seen & self.contains(gaussians.means)


@dataclass(frozen=True)
class LocalDensityControl(Strategy):
    """Another strategy's density control for the Gaussians of a part of a scene.

    Attributes:
        inner: the strategy.
        part: of the scene.
    """

    inner: Strategy = field(kw_only=True)
    part: Part = field(kw_only=True)

    def settings(self) -> Mapping[str, object]:
        """None: they follow from the plan of the blocks, which is compared."""
        return {}

    def initial_state(self, gaussians: Gaussians) -> StrategyState:  # noqa: D102
        return self.inner.initial_state(gaussians)

    def movable(self, gaussians: Gaussians) -> Bool[Tensor, " n"]:
        """Which Gaussians the part holds. Others stay as all parts know them: no pixel that counts
        here shows what they do elsewhere."""
        return self.part.holds(gaussians)

    def observe(  # noqa: D102
        self, passes: Sequence[ScreenPoints]
    ) -> Mapping[str, Float[Tensor, " n"]]:
        return self.inner.observe(passes)

    def after_step(  # noqa: D102
        self, state: StrategyState, optimizer: GaussianOptimizer, step: DensityStep
    ) -> DensityUpdate:
        inside = self.movable(optimizer.gaussians)
        observed = {name: torch.where(inside, each, 0) for name, each in step.observed.items()}
        return self.inner.after_step(state, optimizer, step._replace(observed=observed))


@dataclass(frozen=True)
class FixedGaussians(Strategy):
    """No Gaussians are added or removed."""

    def after_step(  # noqa: D102
        self, state: StrategyState, optimizer: GaussianOptimizer, step: DensityStep
    ) -> DensityUpdate:
        return DensityUpdate(state)
