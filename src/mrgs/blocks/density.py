"""Density control within a part of a scene: what lies outside stays as it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.blocks.region import Region, Ring, ScenePlane
from mrgs.method.density import DensityStep, DensityUpdate, Strategy, StrategyState
from mrgs.method.optimizer import GaussianOptimizer
from mrgs.render import ScreenPoints
from mrgs.scene import Gaussians, Reach


@dataclass(frozen=True)
class Part:
    """A part of a scene: what lies in a region of its plane, without the background.

    Attributes:
        plane: of the scene.
        region: in the plane.
        reach: of the scene.
    """

    plane: ScenePlane
    region: Region | Ring
    reach: Reach

    def contains(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Whether points of the world belong to it."""
        inside = self.region.contains(self.plane.coordinates(points))
        return inside & ~self.reach.is_background(points)


@dataclass(frozen=True)
class LocalDensityControl(Strategy):
    """Another strategy's density control for the Gaussians of a part of a scene.

    Attributes:
        inner: the strategy.
        part: of the scene.
    """

    inner: Strategy = field(kw_only=True)
    part: Part = field(kw_only=True)

    def initial_state(self, gaussians: Gaussians) -> StrategyState:  # noqa: D102
        return self.inner.initial_state(gaussians)

    def movable(self, gaussians: Gaussians) -> Bool[Tensor, " n"]:
        """Those of the part."""
        return self.part.contains(gaussians.means.detach())

    def may_change_at(self, step: int) -> bool:  # noqa: D102
        return self.inner.may_change_at(step)

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

    def may_change_at(self, step: int) -> bool:  # noqa: D102
        return False

    def after_step(  # noqa: D102
        self, state: StrategyState, optimizer: GaussianOptimizer, step: DensityStep
    ) -> DensityUpdate:
        return DensityUpdate(state)
