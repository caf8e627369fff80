"""Depth-aware thermal radiation and the uncertainty-aware loss (Sec. Learning Depth-aware Thermal
Radiation)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from mrgs.errors import ConfigError
from mrgs.method.losses.photometric import masked_mean
from mrgs.method.losses.ssim import structural_similarity
from mrgs.scene.radiometry import TemperatureRange
from mrgs.system.operation import operation
from mrgs.system.strict_yaml import MOST_WEIGHT, require_within

Plane: TypeAlias = Float[Tensor, "h w"]
"""A number for each pixel."""

STEFAN_BOLTZMANN = 5.670374419e-8
"""The paper's τ, in W m⁻² K⁻⁴."""

DEPTH_FLOOR = 1e-3
"""Smallest depth that divides, as a share of the scene's extent."""

QUANTILES = (0.01, 0.99)
"""Quantiles of E_r that become 0 and 1."""

SAMPLED_PIXELS = 5_000
"""Approximate number of pixels that the quantiles are read from."""


@dataclass(frozen=True)
class RadiationConfig:
    """L_boltz: its weight λ_boltz over the steps (Sec. Implementation Details: decayed from 0.05 to
    0.01 during densification).

    Attributes:
        start: λ_boltz up to ``decay_from``.
        end: λ_boltz from ``decay_until`` on.
        decay_from: the step at which the decay starts.
        decay_until: the step at which it ends, with the densification.
    """

    start: float = 0.05
    end: float = 0.01
    decay_from: int = 500
    decay_until: int = 15_000

    def __post_init__(self) -> None:
        if not (self.start > 0 and self.end > 0):
            raise ConfigError(
                f"the weights of L_boltz must be positive, not {self.start} and {self.end}"
            )
        require_within(self, ("start", "end"), 0, MOST_WEIGHT, "the weight {} of L_boltz")
        if not 0 <= self.decay_from < self.decay_until:
            raise ConfigError(
                f"L_boltz cannot decay from step {self.decay_from} to step {self.decay_until}"
            )


def boltzmann_weight(step: int, config: RadiationConfig) -> float:
    """λ_boltz of Eq. 20 (final_loss) at a step: log-linear between its ends, constant outside."""
    progress = (step - config.decay_from) / (config.decay_until - config.decay_from)
    if progress <= 0:
        return config.start
    if progress >= 1:
        return config.end
    return math.exp((1 - progress) * math.log(config.start) + progress * math.log(config.end))


def thermal_radiation(
    target: Plane, depth: Plane, extent: float, temperature: TemperatureRange | None
) -> Plane:
    """E_r, the radiation that arrives at the camera, up to a constant.

    Eq. 13 (stefan_boltzmann), Sec. Depth-aware Thermal Radiation: τ t_GT⁴ / D_t². Differentiable in
    the depth where it exceeds its floor of 1e-3 extents. The ``target`` are the photo's normalised
    temperatures, which ``temperature`` turns into kelvin; without it they stand for t_GT. The
    rendered thermal depth D_t is in scene units, as the extent."""
    kelvin = target if temperature is None else temperature.to_kelvin(target)
    root = math.sqrt(STEFAN_BOLTZMANN) * kelvin**2 / depth.clamp_min(DEPTH_FLOOR * extent)
    return root * root  # differentiated at a third of the cost of a power


def normalise_radiation(radiation: Plane, valid: Bool[Tensor, "h w"] | None = None) -> Plane:
    """E_r brought to [0, 1] by the quantiles of 1 % and 99 % of its valid pixels, as S-SSIM needs
    it to have the scale of I_t; what is beyond them is clipped.

    The least and largest value could be of a single floater near the camera, beside which
    everything else is flat. The quantiles carry gradient, so that L_boltz gains nothing by
    multiplying all depths above their floor: with a fixed scale it would, because E_r becomes the
    flatter the farther everything is, and what is flat contradicts no image. A flat map becomes 0.
    """
    every = max(1, math.isqrt(radiation.numel() // SAMPLED_PIXELS))
    sampled = radiation[::every, ::every].flatten()
    counts = torch.ones_like(sampled, dtype=torch.bool)
    if valid is not None:
        counts = valid[::every, ::every].flatten()
    ascending = torch.where(counts, sampled, math.inf).sort().values
    last = (counts.sum() - 1).clamp_min(0)
    places = [(share * last).round().long() for share in QUANTILES]
    # ``take`` has no deterministic gradient on a GPU.
    low, high = torch.where(counts.any(), ascending.index_select(0, torch.stack(places)), 0)
    span = high - low
    scaled = (radiation - low) / torch.where(span > 1e-6 * high, span, math.inf)
    return scaled.clamp(0, 1)


class DepthUncertainty(nn.Module):
    """u(D_t), where the rendered depth is not to be trusted.

    Eq. 15 (uncertainty), Sec. Uncertainty-aware S-SSIM: u = σ(ψ(D_t)) with a 3 × 3 convolution ψ,
    here on the depth in units of the scene's extent.
    """

    def __init__(self) -> None:
        super().__init__()
        self.psi = nn.Conv2d(1, 1, kernel_size=3, padding=1)

    def forward(self, depth: Plane, extent: float) -> Plane:
        """u in (0, 1) of each pixel; depth and extent in scene units."""
        assert self.psi.bias is not None
        return convolve(depth / extent, self.psi.weight[0, 0], self.psi.bias).sigmoid()


@operation
def convolve(plane: Plane, weights: Float[Tensor, "3 3"], bias: Float[Tensor, "1"]) -> Plane:
    """ψ of Eq. 15: a 3 × 3 convolution with zeros beyond the border."""
    return nn.functional.conv2d(plane[None, None], weights[None, None], bias, padding=1)[0, 0]


@operation
def boltzmann_loss(
    thermal: Plane, radiation: Plane, uncertainty: Plane, valid: Bool[Tensor, "h w"] | None = None
) -> Float[Tensor, ""]:
    """L_boltz, the mean over the pixels of (1 − S-SSIM(I_t, E_r)) / exp(u) + u.

    Eq. 16 (L_boltz), Sec. Uncertainty-aware S-SSIM, with I_t the rendered normalised temperatures,
    E_r from ``normalise_radiation`` and u(D_t) from ``DepthUncertainty``. Pixels that are not valid
    are 0 in both maps, and the mean leaves them out.
    """
    if valid is not None:
        thermal, radiation = torch.where(valid, thermal, 0), torch.where(valid, radiation, 0)
    dissimilarity = 1 - structural_similarity(thermal[None], radiation[None])
    return masked_mean(dissimilarity / uncertainty.exp() + uncertainty, valid)
