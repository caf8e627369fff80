"""3DGS's adaptive density control: clone, split, prune, opacity reset; with a cap on the number of
Gaussians.

The screen-space gradient is that of the whole loss with respect to the projected centre, so in a
fused pass it is the sum over both modalities' blends; where the two cameras differ, the norms of
both passes are added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from mrgs.errors import ConfigError
from mrgs.method.optimizer import GaussianOptimizer
from mrgs.render import ScreenPoints
from mrgs.scene import Gaussians
from mrgs.system.gpu import HOST

SPLIT_INTO = 2
SPLIT_SHRINK = 1.6
"""A split Gaussian becomes two, each 1.6 times smaller (3DGS)."""


@dataclass(frozen=True)
class DensificationConfig:
    """When and how Gaussians are added and removed; the defaults are 3DGS's, without its prune by
    size on the screen.

    Attributes:
        start: no densification up to this step.
        stop: none after this step.
        every: steps between densifications.
        gradient_threshold: mean norm of the screen-space gradient, in 1 / half the image, that
            densifies.
        clone_below: Gaussians smaller than this share of the scene's extent are cloned, larger ones
            split.
        prune_opacity: Gaussians are removed if no modality's opacity reaches this.
        prune_above: Gaussians larger than this share of the extent are removed, after the first
            opacity reset, unless training starts with distant points.
        reset_every: steps between opacity resets, up to ``stop``.
        reset_opacity: what opacities are brought down to.
        max_gaussians: the cap; those with the largest gradients come first.
    """

    start: int = 500
    stop: int = 15_000
    every: int = 100
    gradient_threshold: float = 2e-4
    clone_below: float = 0.01
    prune_opacity: float = 0.005
    prune_above: float = 0.1
    reset_every: int = 3_000
    reset_opacity: float = 0.01
    max_gaussians: int = 5_000_000

    def __post_init__(self) -> None:
        if self.every < 1 or self.reset_every < 1 or self.max_gaussians < 1:
            raise ConfigError(
                "densification: every, reset_every and max_gaussians must be at least 1"
            )
        if not 0 < self.prune_opacity < self.reset_opacity < 1:
            raise ConfigError("densification: 0 < prune_opacity < reset_opacity < 1 must hold")

    def densifies_at(self, step: int) -> bool:
        """Whether Gaussians are added and removed after this step."""
        return self.start < step <= self.stop and step % self.every == 0

    def resets_at(self, step: int) -> bool:
        """Whether the opacities are reset after this step."""
        return step < self.stop and step % self.reset_every == 0


class ScreenStatistics:
    """Sum of the screen-space gradients' norms since the last densification, and the number of
    views that drew each.

    Attributes:
        gradient_sum: [N].
        views: [N].
    """

    def __init__(self, gradient_sum: Float[Tensor, " n"], views: Float[Tensor, " n"]) -> None:
        self.gradient_sum = gradient_sum
        self.views = views

    @classmethod
    def empty(cls, count: int, device: torch.device = HOST) -> ScreenStatistics:
        """Nothing seen yet, of ``count`` Gaussians."""
        return cls(torch.zeros(count, device=device), torch.zeros(count, device=device))

    def copy(self) -> ScreenStatistics:
        """The same numbers in memory of their own."""
        return ScreenStatistics(self.gradient_sum.clone(), self.views.clone())

    def clear(self) -> None:
        """Forget what was seen."""
        self.gradient_sum.zero_()
        self.views.zero_()

    def add(self, passes: Sequence[ScreenPoints], good: Bool[Tensor, ""] | None = None) -> None:
        """Take the gradients of one view's passes, in units of half the image's size as 3DGS counts
        them.

        Args:
            passes: of the view.
            good: whether the view counts; where not, nothing is taken. None if it does.
        """
        drawn = torch.zeros_like(self.views, dtype=torch.bool)
        for points in passes:
            if points.offset.grad is not None:
                norms = (points.offset.grad * _half(points.size, points.offset.device)).norm(dim=1)
                self.gradient_sum += norms if good is None else torch.where(good, norms, 0)
            drawn |= points.radii > 0
        self.views += drawn if good is None else drawn & good

    def mean(self) -> Float[Tensor, " n"]:
        """Mean norm of the gradient over the views that drew the Gaussian."""
        return self.gradient_sum / self.views.clamp_min(1)


@lru_cache(maxsize=16)
def _half(size: tuple[int, int], device: torch.device) -> Float[Tensor, "2"]:
    """Half a width and height; kept, because to copy them anew would make the host wait for a GPU's
    queue."""
    return (torch.tensor(size, dtype=torch.float32) / 2).to(device)


class DensificationCounts(NamedTuple):
    """How many Gaussians an event cloned, split and pruned."""

    cloned: int
    split: int
    pruned: int


@torch.no_grad()
def densify(
    optimizer: GaussianOptimizer,
    statistics: ScreenStatistics,
    config: DensificationConfig,
    extent: float,
    prunes_large: bool,
    generator: torch.Generator,
) -> DensificationCounts:
    """Clone small and split large Gaussians whose screen-space gradient is large; remove
    transparent ones.

    Args:
        optimizer: holds the Gaussians; its rows change.
        statistics: since the last event; started anew.
        config: thresholds and the cap.
        extent: of the scene.
        prunes_large: whether Gaussians above ``prune_above`` are removed too.
        generator: of the places of the split halves.
    """
    gaussians = optimizer.gaussians
    sizes = gaussians.scales.max(dim=1).values
    chosen = _within_budget(statistics.mean(), config, len(gaussians))
    is_large = sizes > config.clone_below * extent
    cloned, split = (chosen & ~is_large).nonzero()[:, 0], (chosen & is_large).nonzero()[:, 0]
    added = _concatenate(_rows(gaussians, cloned), _split(_rows(gaussians, split), generator))
    survives = ~_is_superfluous(gaussians, config, extent, prunes_large)
    added_survives = ~_is_superfluous(added, config, extent, prunes_large)
    pruned = int((~survives).sum() + (~added_survives).sum())
    survives[split] = False
    kept, new = survives.nonzero()[:, 0], _rows(added, added_survives.nonzero()[:, 0])
    replace_rows(optimizer, statistics, kept, new)
    return DensificationCounts(len(cloned), len(split), pruned)


def replace_rows(
    optimizer: GaussianOptimizer,
    statistics: ScreenStatistics,
    keep: Int64[Tensor, " k"],
    added: Gaussians,
) -> None:
    """Keep these rows, append new ones, and start the statistics anew; nothing of it where memory
    does not suffice."""
    empty = ScreenStatistics.empty(len(keep) + len(added), keep.device)
    optimizer.replace_rows(keep, added)
    statistics.gradient_sum, statistics.views = empty.gradient_sum, empty.views


def _within_budget(
    gradients: Float[Tensor, " n"], config: DensificationConfig, count: int
) -> Bool[Tensor, " n"]:
    """Which Gaussians densify: each adds one, and the cap lets only the largest gradients do so."""
    chosen = gradients >= config.gradient_threshold
    budget = max(config.max_gaussians - count, 0)
    if int(chosen.sum()) > budget:
        ranked = torch.where(chosen, gradients, -1).argsort(descending=True, stable=True)
        chosen = torch.zeros_like(chosen)
        chosen[ranked[:budget]] = True
    return chosen


def _is_superfluous(
    gaussians: Gaussians, config: DensificationConfig, extent: float, prunes_large: bool
) -> Bool[Tensor, " n"]:
    """Transparent in both modalities, or too large."""
    superfluous = (
        torch.maximum(gaussians.opacity_rgb, gaussians.opacity_thermal) < config.prune_opacity
    )
    if prunes_large:
        superfluous |= gaussians.scales.max(dim=1).values > config.prune_above * extent
    return superfluous


def _split(gaussians: Gaussians, generator: torch.Generator) -> Gaussians:
    """Two smaller Gaussians for each, at places drawn from it."""
    halves = Gaussians(
        **{
            name: tensor.repeat_interleave(SPLIT_INTO, 0)
            for name, tensor in gaussians.tensors().items()
        }
    )
    noise = draw_normal(halves.means, generator) * halves.scales
    halves.means = halves.means + rotate(halves.quats, noise)
    halves.log_scales = halves.log_scales - torch.tensor(SPLIT_SHRINK).log()
    return halves


def draw_normal(like: Float[Tensor, "*k"], generator: torch.Generator) -> Float[Tensor, "*k"]:
    """Standard normal numbers of a tensor's shape, on its device.

    They are drawn on the host, so that they do not depend on the device, and copied without waiting
    for it.
    """
    numbers = torch.randn(like.shape, generator=generator, pin_memory=like.is_cuda)
    return numbers.to(like.device, non_blocking=True)


def rotate(quats: Float[Tensor, "n 4"], vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Vectors rotated by quaternions wxyz: v + 2w (r × v) + 2 r × (r × v)."""
    unit = torch.nn.functional.normalize(quats, dim=1)
    w, r = unit[:, :1], unit[:, 1:]
    crossed = torch.linalg.cross(r, vectors)
    return vectors + 2 * (w * crossed + torch.linalg.cross(r, crossed))


def _rows(gaussians: Gaussians, rows: Int64[Tensor, " k"]) -> Gaussians:
    return Gaussians(
        **{name: tensor.detach()[rows] for name, tensor in gaussians.tensors().items()}
    )


def _concatenate(first: Gaussians, second: Gaussians) -> Gaussians:
    others = second.tensors()
    return Gaussians(
        **{name: torch.cat([tensor, others[name]]) for name, tensor in first.tensors().items()}
    )
