"""The photometric loss, the opaqueness loss, and the sum of all terms (Sec. Total Loss)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.errors import ConfigError
from mrgs.method.losses.ssim import ssim_map
from mrgs.scene import THERMAL, Modality
from mrgs.system.operation import operation
from mrgs.system.strict_yaml import MOST_WEIGHT, require_within

HALF_COVERED = 0.5
"""Coverage below which a blended depth is that of no surface."""

SMALLEST_DEPTH = 1e-6

SMOOTH_PER_NOISE = 31.25
"""Weight of the temperatures' smoothness per unit of thermal noise (docs/decisions, 049)."""

LEAST_CONTRAST = 50
"""Contrast, in standard deviations of the noise, from which on temperatures are multiplied no
further: their noise would count as much as colours (docs/decisions, 062)."""

BEFORE = 0.1
"""Weight of a thermal surface before the colours', which fog may be, or glass."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses.

    Attributes:
        dssim: λ_D-SSIM of Eq. 17, between 0 (L1 alone) and 1.
        smooth: λ_smooth of Eq. 20.
        smooth_rgb: weight of the colours' part of Eq. 18; 1 in the paper.
        smooth_thermal: weight of the temperatures' part; 1 in the paper.
        smooth_alike: further weight of the temperatures' part between neighbouring pixels of one
            colour, falling as e^(−d / 0.02) with the mean difference d of the rendered colours; 0
            in the paper.
        smooth_depth: weight of the depths' part; 1 in the paper.
        smooth_noise: standard deviation of the thermal photos' noise, normalised temperature, above
            which ``smooth_thermal`` grows with it. Both weights of temperatures also grow with the
            root of the number of RGB photos per thermal photo. None in the paper: neither matters.
        huber_noise: width of a Huber loss of temperatures, quadratic below and linear above, in
            standard deviations of the thermal photos' noise; 0 in the paper: L1.
        full_contrast: contrast of the thermal photos, normalised temperature, below which
            temperatures and their differences are multiplied until it is that, before they are
            compared and smoothed. None in the paper: a lamp that widens the scale makes all else
            count less.
        opaque: weight of L_opaque; 0 in the paper.
        distortion: weight of L_dist; 0 in the paper.
    """

    dssim: float = 0.2
    smooth: float = 0.6
    smooth_rgb: float = 1.0
    smooth_thermal: float = 1.0
    smooth_alike: float = 0.0
    smooth_depth: float = 1.0
    smooth_noise: float | None = None
    huber_noise: float = 0.0
    full_contrast: float | None = None
    opaque: float = 0.0
    distortion: float = 0.0

    def smooth_image(
        self, modality: Modality, thermal_noise: float, rgb_per_thermal: float
    ) -> tuple[float, float]:
        """Weights of a modality's image in Eq. 18: everywhere, and between pixels of one colour.

        Temperatures have their own, which may depend on how noisy and how few the thermal photos
        are (``SceneScale``), all others that of the colours.
        """
        if modality != THERMAL:
            return self.smooth_rgb, 0.0
        # Without RGB photos the colours, those of the start points, would be an arbitrary guide.
        alike = self.smooth_alike if rgb_per_thermal > 0 else 0.0
        if self.smooth_noise is None:
            return self.smooth_thermal, alike
        noise = max(thermal_noise - self.smooth_noise, 0.0)
        everywhere = self.smooth_thermal + SMOOTH_PER_NOISE * noise
        growth = max(rgb_per_thermal, 1.0) ** 0.5
        return growth * everywhere, growth * alike

    def gain(self, modality: Modality, thermal_contrast: float, thermal_noise: float) -> float:
        """What a modality's values are multiplied by before they are compared and smoothed: 1 but
        for temperatures of little contrast that is yet well above their noise."""
        if modality != THERMAL or self.full_contrast is None:
            return 1.0
        contrast = max(thermal_contrast, LEAST_CONTRAST * thermal_noise, 1e-3)
        return max(1.0, self.full_contrast / contrast)

    def huber_width(self, modality: Modality, thermal_noise: float) -> float:
        """Difference below which a modality's values are compared by their squares."""
        return self.huber_noise * thermal_noise if modality == THERMAL else 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.dssim <= 1:
            raise ConfigError(f"dssim must lie between 0 and 1, not {self.dssim}")
        shares = {"smooth_noise", "full_contrast"}
        others = {field.name for field in fields(self)} - {"dssim", *shares}
        require_within(self, sorted(others), 0, MOST_WEIGHT)
        given = [name for name in sorted(shares) if getattr(self, name) is not None]
        require_within(self, given, 1e-6, 1)


@operation
def photometric_loss(
    render: Float[Tensor, "h w c"],
    target: Float[Tensor, "h w c"],
    valid: Bool[Tensor, "h w"] | None,
    dssim: float,
    huber_width: float = 0.0,
) -> Float[Tensor, ""]:
    """L_m for either modality.

    Eq. 17 (L_m), Sec. Total Loss: (1 − λ) L1 + λ L_D-SSIM with L_D-SSIM = 1 − SSIM, as in 3DGS. Not
    in the paper: with a width δ, L1 is a Huber loss, d² / 2δ where a difference d is smaller and
    |d| − δ/2 where it is larger.

    Render and photo have the same units, as δ; 0 is L1. Pixels that are not valid are 0 in both
    images, and the mean leaves them out.
    """
    if valid is not None:
        render, target = (torch.where(valid[:, :, None], image, 0) for image in (render, target))
    x, y = (image.permute(2, 0, 1).contiguous() for image in (render, target))
    error = (1 - dssim) * _huber(x - y, huber_width)
    if dssim > 0:
        error = error + dssim * (1 - ssim_map(x, y))
    return masked_mean(error, valid)


def _huber(difference: Float[Tensor, "c h w"], width: float) -> Float[Tensor, "c h w"]:
    """|d| − δ/2, and d² / 2δ where |d| < δ."""
    size = difference.abs()
    if width == 0:
        return size
    return torch.where(size < width, difference.square() / (2 * width), size - width / 2)


def opaqueness_loss(
    alpha_thermal: Float[Tensor, "h w"],
    alpha_rgb: Float[Tensor, "h w"],
    depth_thermal: Float[Tensor, "h w"],
    depth_rgb: Float[Tensor, "h w"],
) -> Float[Tensor, ""]:
    """L_opaque: what blocks light blocks heat radiation too; not in the paper.

    The mean of max(0, α_c − α_t) + max(0, 1 − d_c / d_t) + 0.1 max(0, 1 − d_t / d_c), with d = D /
    α the depth of the surface: the thermal image may neither be more transparent than the colours
    nor look behind what they show. Without it a surface whose temperature is that of what lies
    behind it, or of the background, may as well be transparent. What the thermal image shows before
    the colours' surface costs less: it may be glass, which lets light pass alone. α_c and d_c carry
    no gradient. All are of blends by one camera, D in scene units.
    """
    alpha_rgb = alpha_rgb.detach()
    surface_rgb = depth_rgb.detach() / alpha_rgb.clamp_min(HALF_COVERED)
    surface_thermal = depth_thermal / alpha_thermal.clamp_min(HALF_COVERED)
    behind = (1 - surface_rgb / surface_thermal.clamp_min(SMALLEST_DEPTH)).relu()
    before = (1 - surface_thermal / surface_rgb.clamp_min(SMALLEST_DEPTH)).relu()
    apart = torch.where(alpha_rgb >= HALF_COVERED, behind + BEFORE * before, 0)
    return ((alpha_rgb - alpha_thermal).relu() + apart).mean()


def total_loss(
    terms: Mapping[str, Float[Tensor, ""]], weights: Mapping[str, float | Float[Tensor, ""]]
) -> Float[Tensor, ""]:
    """Eq. 20 (final_loss), Sec. Total Loss: L_c + L_t + λ_smooth L_smooth + λ_boltz L_boltz, of the
    terms that a view and a method have. KeyError for a term without a weight, ValueError for no
    term at all."""
    if not terms:
        raise ValueError("a loss needs at least one term")
    return torch.stack([weights[name] * term for name, term in terms.items()]).sum()


def masked_mean(
    planes: Float[Tensor, "c h w"], valid: Bool[Tensor, "h w"] | None
) -> Float[Tensor, ""]:
    """Mean over all channels of the valid pixels; 0 if no pixel is valid."""
    if valid is None:
        return planes.mean()
    return torch.where(valid, planes, 0).sum() / (valid.sum() * len(planes)).clamp_min(1)
