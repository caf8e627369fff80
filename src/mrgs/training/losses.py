"""The photometric loss, the smoothness loss, and their sum (Sec. Total Loss)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mrgs.errors import ConfigError
from mrgs.training.ssim import ssim_map


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses.

    Attributes:
        dssim: λ_D-SSIM of Eq. 17, between 0 (L1 alone) and 1.
        smooth: λ_smooth of Eq. 20.
        smooth_image: weight of the image's part of Eq. 18; 1 in the paper.
        smooth_depth: weight of the depth's part of Eq. 18; 1 in the paper.
        edge_aware: weigh the smoothness by exp(−β |∇ target|), so that it stops at the photo's edges.
        beta: β of the edge weight; the paper names it without using it.
    """

    dssim: float = 0.2
    smooth: float = 0.6
    smooth_image: float = 1.0
    smooth_depth: float = 1.0
    edge_aware: bool = False
    beta: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.dssim <= 1:
            raise ConfigError(f"dssim must lie between 0 and 1, not {self.dssim}")
        for name in ("smooth", "smooth_image", "smooth_depth", "beta"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name} must be 0 or more, not {getattr(self, name)}")


def photometric_loss(
    render: Float[Tensor, "h w c"],
    target: Float[Tensor, "h w c"],
    valid: Bool[Tensor, "h w"] | None,
    dssim: float,
) -> Float[Tensor, ""]:
    """L_m for either modality.

    Eq. 17 (L_m), Sec. Total Loss: (1 − λ) L1 + λ L_D-SSIM with L_D-SSIM = 1 − SSIM, as in 3DGS.

    Args:
        render: the rendered image.
        target: the photo, in the same units.
        valid: pixels that count, all if None. The others are 0 in both images, and the mean leaves them out.
        dssim: λ.
    """
    if valid is not None:
        render, target = (torch.where(valid[:, :, None], image, 0) for image in (render, target))
    x, y = _planes(render), _planes(target)
    error = (1 - dssim) * (x - y).abs()
    if dssim > 0:
        error = error + dssim * (1 - ssim_map(x, y))
    return masked_mean(error, valid)


def smoothness_loss(
    image: Float[Tensor, "h w c"],
    depth: Float[Tensor, "h w"],
    target: Float[Tensor, "h w c"],
    valid: Bool[Tensor, "h w"] | None,
    extent: float,
    config: LossConfig,
) -> Float[Tensor, ""]:
    """L_smooth of one modality; the sum over both is Eq. 19 (smooth_total).

    Eq. 18 (smooth_sepa), Sec. Total Loss: |∇I| + |∇D|, here as a mean over the pixels, the depth in units of the
    scene's extent.

    Args:
        image: rendered colours or normalised temperatures.
        depth: rendered depth in scene units.
        target: the photo, whose edges count if ``config.edge_aware``.
        valid: pixels that count, all if None.
        extent: the scene's extent in scene units.
        config: the weights of the two parts, and the edge weight.
    """
    edges = _planes(target) if config.edge_aware else None
    loss = config.smooth_image * total_variation(_planes(image), valid, edges, config.beta)
    return loss + config.smooth_depth * total_variation(depth[None] / extent, valid, edges, config.beta)


def total_variation(
    planes: Float[Tensor, "c h w"],
    valid: Bool[Tensor, "h w"] | None = None,
    edges: Float[Tensor, "e h w"] | None = None,
    beta: float = 1.0,
) -> Float[Tensor, ""]:
    """Mean absolute first difference along the columns plus the same along the rows; 0 along an axis of one pixel.

    Args:
        planes: an image.
        valid: differences count between two valid pixels; between any two if None.
        edges: another image; each difference is weighed by exp(−β |its difference|), mean over its channels.
        beta: β, how sharply an edge cuts the weight.
    """
    total = planes.new_zeros(())
    for axis in (1, 2):
        if planes.shape[axis] < 2:
            continue
        difference = planes.diff(dim=axis).abs()
        if edges is not None:
            difference = difference * torch.exp(-beta * edges.diff(dim=axis).abs().mean(dim=0))
        total = total + masked_mean(difference, None if valid is None else _both_ends(valid, axis - 1))
    return total


def _both_ends(valid: Bool[Tensor, "h w"], axis: int) -> Bool[Tensor, "h2 w2"]:
    """Whether both pixels of each first difference are valid."""
    steps = valid.shape[axis] - 1
    return valid.narrow(axis, 0, steps) & valid.narrow(axis, 1, steps)


def total_loss(
    terms: Mapping[str, Float[Tensor, ""]], smooth_weight: float, boltzmann_weight: float
) -> Float[Tensor, ""]:
    """Eq. 20 (final_loss), Sec. Total Loss: L_c + L_t + λ_smooth L_smooth + λ_boltz L_boltz.

    Args:
        terms: any of "rgb", "thermal", "smooth" and "boltzmann"; what a view or a method lacks is left out.
        smooth_weight: λ_smooth.
        boltzmann_weight: λ_boltz of this step.

    Raises:
        KeyError: a term of another name.
        ValueError: no term at all.
    """
    if not terms:
        raise ValueError("a loss needs at least one term")
    weights = {"rgb": 1.0, "thermal": 1.0, "smooth": smooth_weight, "boltzmann": boltzmann_weight}
    return torch.stack([weights[name] * term for name, term in terms.items()]).sum()


def masked_mean(planes: Float[Tensor, "c h w"], valid: Bool[Tensor, "h w"] | None) -> Float[Tensor, ""]:
    """Mean over all channels of the valid pixels; 0 if no pixel is valid."""
    if valid is None:
        return planes.mean()
    return torch.where(valid, planes, 0).sum() / (valid.sum() * len(planes)).clamp_min(1)


def _planes(image: Float[Tensor, "h w c"]) -> Float[Tensor, "c h w"]:
    return image.permute(2, 0, 1).contiguous()
