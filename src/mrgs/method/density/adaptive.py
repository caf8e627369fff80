"""3DGS's adaptive density control: clone, split, prune, opacity reset; with a cap on the number of
Gaussians. The screen-space gradient is that of the whole loss with respect to the projected centre,
summed over a fused pass's blends; where cameras differ, both passes' norms are added."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from mrgs.errors import ConfigError
from mrgs.method.density.strategy import DensityStep, DensityUpdate, Strategy, StrategyState
from mrgs.method.optimizer import GaussianOptimizer
from mrgs.render import ScreenPoints
from mrgs.scene import Gaussians
from mrgs.scene.arrays import constant
from mrgs.system.strict_yaml import MOST_STEPS, MOST_WEIGHT, require_within

SPLIT_SHRINK = 1.6
"""A split Gaussian becomes two, each 1.6 times smaller (3DGS)."""

HALF_LENGTH, HALF_WIDTH, HALF_OPACITY = 0.5, 0.85, 0.6
"""Sizes and opacities of the halves of a Gaussian that is split along its longest axis, as shares
of its own."""


@dataclass(frozen=True)
class AdaptiveDensityControl(Strategy):
    """3DGS's adaptive density control, without its prune by size on the screen; the defaults are
    3DGS's.

    It remembers, for each Gaussian since the last densification, the sum of the norms of its
    screen-space gradients (``gradient_sum``, [N]) and the number of views that drew it (``views``,
    [N]).

    Attributes:
        start: no densification up to this step.
        stop: none after this step.
        every: steps between densifications.
        gradient_threshold: mean norm of the screen-space gradient, in 1 / half the image, that
            densifies.
        clone_below: Gaussians smaller than this share of the scene's extent are cloned, larger ones
            split.
        split_longest: all of them are split instead, along the longest axis, into halves side by
            side (docs/decisions, 075).
        prune_opacity: Gaussians are removed if no modality's opacity reaches this.
        prune_unshared: also if one modality's does not (docs/decisions, 009).
        prune_above: Gaussians larger than this share of the extent are removed, after the first
            opacity reset, unless training starts with distant points.
        reset_every: steps between opacity resets, up to ``stop``; None for no resets.
        reset_opacity: what opacities are brought down to.
        max_gaussians: the cap; those with the largest gradients come first.
    """

    name: Literal["adaptive"] = "adaptive"
    start: int = 500
    stop: int = 15_000
    every: int = 100
    gradient_threshold: float = 2e-4
    clone_below: float = 0.01
    split_longest: bool = False
    prune_opacity: float = 0.005
    prune_unshared: bool = False
    prune_above: float = 0.1
    reset_every: int | None = 3_000
    reset_opacity: float = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        title = "{} of the densification"
        counts = ("every",) if self.reset_every is None else ("every", "reset_every")
        require_within(self, counts, 1, MOST_STEPS, title)
        require_within(self, ("start", "stop"), 0, MOST_STEPS, title)
        sizes = ("gradient_threshold", "clone_below", "prune_above")
        require_within(self, sizes, 0, MOST_WEIGHT, title)
        if not 0 < self.prune_opacity < self.reset_opacity < 1:
            raise ConfigError("densification: 0 < prune_opacity < reset_opacity < 1 must hold")

    def initial_state(self, gaussians: Gaussians) -> StrategyState:
        """No view drew any of them yet."""
        return _no_views(len(gaussians), gaussians.means.device)

    def observe(self, passes: Sequence[ScreenPoints]) -> dict[str, Float[Tensor, " n"]]:
        """A view's gradient norms, in units of half the image's size (3DGS), and what it drew."""
        norms = []
        for points in passes:
            if points.offset.grad is not None:
                width, height = points.size
                half_size = constant((width / 2, height / 2), points.offset)
                norms.append((points.offset.grad * half_size).norm(dim=1))
        drawn = torch.stack([points.radii > 0 for points in passes]).any(dim=0).float()
        return {
            "gradient_sum": torch.stack(norms).sum(dim=0) if norms else torch.zeros_like(drawn),
            "views": drawn,
        }

    def after_step(
        self, state: StrategyState, optimizer: GaussianOptimizer, step: DensityStep
    ) -> DensityUpdate:
        """Add the views' gradients; clone, split, prune and reset when they are due."""
        state = {name: total + step.observed[name] for name, total in state.items()}
        densifies, resets = self.densifies_at(step.number), self.resets_at(step.number)
        if not (densifies or resets) or step.skipped:
            return DensityUpdate(state)
        counts, gaussians = None, optimizer.gaussians
        if densifies:
            gradients = mean_gradients(state)
            was_reset = self.reset_every is not None and step.number > self.reset_every
            prunes_large = was_reset and not step.has_sky
            change = densify(gaussians, gradients, self, step.extent, prunes_large, step.generator)
            state = _no_views(len(change.keep) + len(change.added), change.keep.device)
            optimizer.replace_rows(change.keep, change.added)
            counts = change.counts
        if resets:
            optimizer.limit_opacities(self.reset_opacity)
        return DensityUpdate(state, counts)

    def rescaled(self, factor: float) -> AdaptiveDensityControl:
        """Start and stop move; opacity resets do not: the opacities need steps to recover."""
        start, stop = (max(1, round(step * factor)) for step in (self.start, self.stop))
        return replace(self, start=start, stop=stop)

    def with_batch(self, batch: int) -> AdaptiveDensityControl:
        """As many views between densifications; the mean gradient of a view stays what it is."""
        return replace(self, every=max(1, round(self.every / batch)))

    def densifies_at(self, step: int) -> bool:
        """Whether Gaussians are added and removed after this step."""
        return self.start < step <= self.stop and step % self.every == 0

    def resets_at(self, step: int) -> bool:
        """Whether the opacities are reset after this step."""
        return self.reset_every is not None and step < self.stop and step % self.reset_every == 0


def _no_views(count: int, device: torch.device) -> StrategyState:
    """The statistics of Gaussians that no view drew."""
    return {name: torch.zeros(count, device=device) for name in ("gradient_sum", "views")}


def mean_gradients(state: StrategyState) -> Float[Tensor, " n"]:
    """Mean norm of the gradient over the views that drew each Gaussian."""
    return state["gradient_sum"] / state["views"].clamp_min(1)


class RowChange(NamedTuple):
    """Which Gaussians stay, in this order, which follow them, and the numbers of Gaussians that
    were cloned, split and pruned."""

    keep: Int64[Tensor, " k"]
    added: Gaussians
    counts: dict[str, int]


@torch.no_grad()
def densify(
    gaussians: Gaussians,
    gradients: Float[Tensor, " n"],
    config: AdaptiveDensityControl,
    extent: float,
    prunes_large: bool,
    generator: torch.Generator,
) -> RowChange:
    """Clone small and split large Gaussians whose screen-space gradient is large, or split all of
    these along their longest axes; remove transparent ones.

    Args:
        gradients: mean norm of each Gaussian's screen-space gradient.
        config: thresholds and the cap.
        prunes_large: whether Gaussians above ``prune_above`` are removed too.
        generator: of the places of the split halves.
    """
    sizes = gaussians.scales.max(dim=1).values
    chosen = _within_budget(gradients, config, len(gaussians))
    splits = chosen & (config.split_longest | (sizes > config.clone_below * extent))
    cloned, split = (chosen & ~splits).nonzero()[:, 0], splits.nonzero()[:, 0]
    parents = gaussians.rows(split)
    halves = _halves(parents) if config.split_longest else _split(parents, generator)
    added = gaussians.rows(cloned).followed_by(halves)
    survives = ~_is_superfluous(gaussians, config, extent, prunes_large)
    added_survives = ~_is_superfluous(added, config, extent, prunes_large)
    pruned = int((~survives).sum() + (~added_survives).sum())
    survives[split] = False
    return RowChange(
        keep=survives.nonzero()[:, 0],
        added=added.rows(added_survives.nonzero()[:, 0]),
        counts={"cloned": len(cloned), "split": len(split), "pruned": pruned},
    )


def _within_budget(
    gradients: Float[Tensor, " n"], config: AdaptiveDensityControl, count: int
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
    gaussians: Gaussians, config: AdaptiveDensityControl, extent: float, prunes_large: bool
) -> Bool[Tensor, " n"]:
    """Transparent in all modalities, or in any, or too large."""
    opacities = torch.stack([gaussians.opacity(modality) for modality in gaussians.modalities])
    decisive = opacities.amin(dim=0) if config.prune_unshared else opacities.amax(dim=0)
    superfluous = decisive < config.prune_opacity
    if prunes_large:
        superfluous |= gaussians.scales.max(dim=1).values > config.prune_above * extent
    return superfluous


def _twice(gaussians: Gaussians) -> Gaussians:
    rows = torch.arange(len(gaussians), device=gaussians.means.device)
    return gaussians.rows(rows.repeat_interleave(2))


def _split(gaussians: Gaussians, generator: torch.Generator) -> Gaussians:
    """Two smaller Gaussians for each, at places drawn from it."""
    halves = _twice(gaussians)
    means = halves.means
    # Drawn on the host, so that they do not depend on the device, and copied without waiting.
    normal = torch.randn(means.shape, generator=generator, pin_memory=means.is_cuda)
    noise = normal.to(means.device, non_blocking=True) * halves.scales
    halves.means = means + _rotate(halves.quats, noise)
    halves.log_scales = halves.log_scales - torch.tensor(SPLIT_SHRINK).log()
    return halves


def _halves(gaussians: Gaussians) -> Gaussians:
    """Two for each, side by side along its longest axis; together they are as long as it is, by the
    variance along that axis."""
    halves = _twice(gaussians)
    longest = nn.functional.one_hot(halves.log_scales.argmax(dim=1), 3)
    sides = 1 - 2 * torch.arange(len(longest), device=longest.device).remainder(2)[:, None]
    apart = math.sqrt(1 - HALF_LENGTH**2) * sides * longest * halves.scales
    halves.means += _rotate(halves.quats, apart)
    halves.log_scales += (HALF_LENGTH * longest + HALF_WIDTH * (1 - longest)).log()
    for modality, logits in halves.opacity_logits.items():
        halves.opacity_logits[modality] = (HALF_OPACITY * logits.sigmoid()).logit()
    return halves


def _rotate(quats: Float[Tensor, "n 4"], vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Vectors rotated by quaternions wxyz: v + 2w (r × v) + 2 r × (r × v)."""
    unit = nn.functional.normalize(quats, dim=1)
    w, r = unit[:, :1], unit[:, 1:]
    crossed = torch.linalg.cross(r, vectors)
    return vectors + 2 * (w * crossed + torch.linalg.cross(r, crossed))
