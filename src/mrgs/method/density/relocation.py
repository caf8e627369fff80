"""Densification that meets a budget: transparent Gaussians move to where they are needed, none is
split or pruned.

From "3D Gaussian Splatting as Markov Chain Monte Carlo" (Kheradmand et al., NeurIPS 2024): a dead
Gaussian becomes a copy of a live one, drawn by opacity; the copies' opacities and sizes are chosen
so that together they look like the one before; noise on the means lets the transparent ones
explore.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from mrgs.errors import ConfigError
from mrgs.method.density.densification import ScreenStatistics, draw_normal, replace_rows, rotate
from mrgs.method.optimizer import GaussianOptimizer
from mrgs.scene import Gaussians

MOST_COPIES = 32
"""Beyond it the alternating sum of ``shrinkage`` loses its digits."""

NOISE_GATE_SLOPE = 100.0
NOISE_GATE_OPACITY = 0.005
"""Noise moves Gaussians around and below this opacity; 100 is how sharply it stops above (the
authors' values)."""


@dataclass(frozen=True)
class RelocationConfig:
    """When and how Gaussians are moved and added.

    Attributes:
        start: none up to this step.
        stop: none after this step; the budget is reached by then.
        every: steps between events.
        dead_below: Gaussians are moved if no modality's opacity reaches this.
        noise: of the means at each step, in learning rates of the means.
        opacity_weight: of the mean opacity in the loss, so that what is not needed turns
            transparent.
        scale_weight: of the mean scale in the loss, in scene extents.
    """

    start: int = 500
    stop: int = 25_000
    every: int = 100
    dead_below: float = 0.005
    noise: float = 5e5
    opacity_weight: float = 0.01
    scale_weight: float = 0.01

    def __post_init__(self) -> None:
        if self.every < 1 or self.start >= self.stop:
            raise ConfigError(
                "relocation: every must be at least 1, and start must come before stop"
            )

    def relocates_at(self, step: int) -> bool:
        """Whether Gaussians are moved and added after this step."""
        return self.start < step <= self.stop and step % self.every == 0

    def events_left(self, step: int) -> int:
        """Events from this one on, this one included."""
        return (self.stop - step) // self.every + 1


class RelocationCounts(NamedTuple):
    """How many Gaussians an event moved and added."""

    moved: int
    added: int


@torch.no_grad()
def relocate(
    optimizer: GaussianOptimizer,
    config: RelocationConfig,
    step: int,
    budget: int,
    generator: torch.Generator,
    statistics: ScreenStatistics | None = None,
) -> RelocationCounts:
    """Move dead Gaussians to live ones and add new ones, so that the budget is reached
    geometrically by ``stop``.

    Args:
        optimizer: holds the Gaussians; its rows change.
        config: thresholds and schedule.
        step: of the training.
        budget: largest number of Gaussians.
        generator: of the draws.
        statistics: of the Gaussians, which are started anew where the rows change; None where there
            are none.
    """
    gaussians = optimizer.gaussians
    opacity = torch.maximum(gaussians.opacity_rgb, gaussians.opacity_thermal)
    alive = (opacity > config.dead_below).nonzero()[:, 0]
    dead = len(gaussians) - len(alive)
    wanted = round(
        len(gaussians) * (max(budget, 1) / len(gaussians)) ** (1 / config.events_left(step))
    )
    added = max(min(wanted, budget) - len(gaussians), 0)
    if len(alive) == 0 or dead + added == 0:
        return RelocationCounts(0, 0)
    # On the host, so that the draws do not depend on the device.
    drawn = torch.multinomial(
        opacity[alive].cpu(), dead + added, replacement=True, generator=generator
    ).to(alive)
    copies = 1 + torch.bincount(drawn, minlength=len(alive))
    copied = copies > 1
    statistics = statistics or ScreenStatistics.empty(len(gaussians), alive.device)
    replace_rows(
        optimizer, statistics, alive[~copied], _copies(gaussians, alive[copied], copies[copied])
    )
    return RelocationCounts(dead, added)


def _copies(
    gaussians: Gaussians, rows: Int64[Tensor, " k"], counts: Int64[Tensor, " k"]
) -> Gaussians:
    """Each of these Gaussians as several, which together look like it."""
    several = rows.repeat_interleave(counts)
    counts = counts.repeat_interleave(counts)
    copies = Gaussians(
        **{name: tensor.detach()[several] for name, tensor in gaussians.tensors().items()}
    )
    strongest = torch.maximum(copies.opacity_rgb, copies.opacity_thermal)
    copies.log_scales = copies.log_scales + shrinkage(strongest, counts).log()[:, None]
    for name in ("opacity_rgb_logit", "opacity_thermal_logit"):
        logits = getattr(copies, name)
        setattr(
            copies,
            name,
            torch.logit(
                shared_opacity(logits.sigmoid(), counts[:, None].expand_as(logits)), eps=1e-6
            ),
        )
    return copies


def shared_opacity(
    opacity: Float[Tensor, "*k"], counts: Int64[Tensor, "*k"]
) -> Float[Tensor, "*k"]:
    """o' of ``counts`` Gaussians in one place that let through as much as one of ``opacity``: 1 −
    (1 − o)^(1/n)."""
    return 1 - (1 - opacity) ** (1 / counts.to(opacity.dtype))


def shrinkage(opacity: Float[Tensor, " k"], counts: Int64[Tensor, " k"]) -> Float[Tensor, " k"]:
    """The factor on the copies' scales that keeps the integral of their blend.

    Eq. 9 of the paper named above, its inner sums carried out: o / Σ_j (−1)^(j−1) C(n, j) o'^j /
    √j.
    """
    counts = counts.clamp_max(MOST_COPIES)
    n = counts.double()[:, None]
    j = torch.arange(1, MOST_COPIES + 1, dtype=torch.float64, device=counts.device)
    binomial = (
        torch.lgamma(n + 1) - torch.lgamma(j + 1) - torch.lgamma((n - j).clamp_min(0) + 1)
    ).exp()
    signed = torch.where(j % 2 == 1, 1.0, -1.0) * binomial * (j <= n) / j.sqrt()
    x = shared_opacity(opacity.double(), counts)
    return (opacity / (signed * x[:, None] ** j).sum(dim=1)).to(opacity.dtype)


@torch.no_grad()
def explore(
    gaussians: Gaussians,
    rate: float,
    config: RelocationConfig,
    generator: torch.Generator,
    good: Bool[Tensor, ""] | None = None,
) -> None:
    """Add noise in the shape of each Gaussian to its mean, the less the more opaque it is.

    The means move last: where a GPU's memory does not suffice, they are as they were.

    Args:
        gaussians: whose means are moved in place.
        rate: learning rate of the means, in scene units.
        config: strength of the noise.
        generator: of the noise, which is drawn in any case.
        good: whether the means are moved; None if they are.
    """
    opacity = torch.maximum(gaussians.opacity_rgb, gaussians.opacity_thermal)
    gate = torch.sigmoid(NOISE_GATE_SLOPE * (NOISE_GATE_OPACITY - opacity))
    noise = draw_normal(gaussians.means, generator) * (config.noise * rate * gate)[:, None]
    inverse = torch.cat([gaussians.quats[:, :1], -gaussians.quats[:, 1:]], dim=1)
    motion = rotate(gaussians.quats, rotate(inverse, noise) * gaussians.scales.square())
    gaussians.means += motion if good is None else torch.where(good, motion, 0)


def sparsity_loss(
    gaussians: Gaussians, extent: float, config: RelocationConfig
) -> Float[Tensor, ""]:
    """Weighted mean opacity of each modality, plus weighted mean scale in extents."""
    opacity = gaussians.opacity_rgb.mean()
    if gaussians.opacity_thermal_logit.shape[1] > 0:
        opacity = 0.5 * (opacity + gaussians.opacity_thermal.mean())
    return config.opacity_weight * opacity + config.scale_weight * gaussians.scales.mean() / extent
