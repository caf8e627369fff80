"""The photometric loss, the smoothness loss, and their sum (Sec. Total Loss)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from mrgs.errors import ConfigError
from mrgs.method.cpu.variation import STRIP_ROWS, sum_differences
from mrgs.method.losses.dissimilarity import l1_dssim, serves
from mrgs.method.losses.known_gradient import with_gradients
from mrgs.method.losses.ssim import ssim_map
from mrgs.system import gpu

HALF_COVERED = 0.5
"""Where less is covered, a blended depth is that of no surface."""

SMALLEST_DEPTH = 1e-6


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses.

    Attributes:
        dssim: λ_D-SSIM of Eq. 17, between 0 (L1 alone) and 1.
        smooth: λ_smooth of Eq. 20.
        smooth_rgb: weight of the colours' part of Eq. 18; 1 in the paper.
        smooth_thermal: weight of the temperatures' part; 1 in the paper.
        smooth_depth: weight of the depths' part; 1 in the paper.
        opaque: weight of L_opaque; 0 in the paper.
        edge_aware: weigh the smoothness by exp(−β |∇ target|), so that it stops at the photo's
            edges.
        beta: β of the edge weight; the paper names it without using it.
    """

    dssim: float = 0.2
    smooth: float = 0.6
    smooth_rgb: float = 1.0
    smooth_thermal: float = 1.0
    smooth_depth: float = 1.0
    opaque: float = 0.0
    edge_aware: bool = False
    beta: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.dssim <= 1:
            raise ConfigError(f"dssim must lie between 0 and 1, not {self.dssim}")
        for name in ("smooth", "smooth_rgb", "smooth_thermal", "smooth_depth", "opaque", "beta"):
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
        valid: pixels that count, all if None. The others are 0 in both images, and the mean leaves
            them out.
        dssim: λ.
    """
    if not serves(render):
        return _photometric_loss(render, target, valid, dssim)
    compared = l1_dssim(
        render, target, mean_weights(render[:, :, 0], valid) / render.shape[2], dssim
    )
    return with_gradients(compared.total, (render, target), (compared.grad_x, compared.grad_y))


def _photometric_loss(render: Tensor, target: Tensor, valid: Tensor | None, dssim: float) -> Tensor:
    """Eq. 17 in plain torch, for other devices; the fused kernels are tested against it."""
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
    image_weight: float,
    config: LossConfig,
) -> Float[Tensor, ""]:
    """L_smooth of one modality; the sum over both is Eq. 19 (smooth_total).

    Eq. 18 (smooth_sepa), Sec. Total Loss: |∇I| + |∇D|, here as a mean over the pixels, the depth in
    units of the scene's extent.

    Args:
        image: rendered colours or normalised temperatures.
        depth: rendered depth in scene units.
        target: the photo, whose edges count if ``config.edge_aware``.
        valid: pixels that count, all if None.
        extent: the scene's extent in scene units.
        image_weight: of the image's part.
        config: the weight of the depth's part, and the edge weight.
    """
    edges = target if config.edge_aware else None
    weights = [
        difference_weights(image[:, :, 0], axis, valid, edges, config.beta) for axis in (0, 1)
    ]
    loss = image.new_zeros(())
    if image_weight > 0:
        loss = loss + image_weight * total_variation(image, weights)
    if config.smooth_depth > 0:
        loss = loss + config.smooth_depth / extent * total_variation(depth[:, :, None], weights)
    return loss


class DifferenceWeights(NamedTuple):
    """How the first differences along one axis count.

    Attributes:
        counted: how many do; where a mask decides and the image is not on the CPU, a tensor beside
            it.
        weights: [H − 1, W] between rows or [H, W − 1] between columns, 0 for those that do not;
            None for 1.
    """

    counted: int | Int64[Tensor, ""]
    weights: Float[Tensor, "h2 w2"] | None


def difference_weights(
    plane: Float[Tensor, "h w"],
    axis: int,
    valid: Bool[Tensor, "h w"] | None = None,
    edges: Float[Tensor, "h w e"] | None = None,
    beta: float = 1.0,
) -> DifferenceWeights:
    """Differences count between two valid pixels, and the less the sharper the edge.

    Args:
        plane: has the size and the type of the image.
        axis: 0 for the differences between rows, 1 for those between columns.
        valid: pixels that count, all if None.
        edges: an image; each difference is weighed by exp(−β |its difference|), mean over its
            channels; 1 if None.
        beta: β, how sharply an edge cuts the weight.
    """
    height, width = plane.shape
    counted: int | Tensor = (height - 1) * width if axis == 0 else height * (width - 1)
    weights = None
    if edges is not None:
        weights = torch.exp(-beta * edges.diff(dim=axis).abs().mean(dim=2))
    if valid is not None:
        steps = valid.shape[axis] - 1
        both = valid.narrow(axis, 0, steps) & valid.narrow(axis, 1, steps)
        counted = int(both.sum()) if both.device.type == "cpu" else both.sum()
        weights = both.to(plane.dtype) if weights is None else torch.where(both, weights, 0)
    return DifferenceWeights(counted, weights)


def total_variation(
    image: Float[Tensor, "h w c"], weights: Sequence[DifferenceWeights]
) -> Float[Tensor, ""]:
    """Mean absolute first difference between rows plus the same between columns; 0 where there are
    none.

    Args:
        image: float32 or float64.
        weights: how the differences between rows and those between columns count.
    """
    if gpu.serves(image):
        return _total_variation_on_gpu(image, weights)
    return (
        _total_variation_on_cpu(image, weights)
        if image.device.type == "cpu"
        else _total_variation(image, weights)
    )


def _total_variation_on_cpu(image: Tensor, weights: Sequence[DifferenceWeights]) -> Tensor:
    height, width, channels = image.shape
    pixels = image.detach().contiguous()
    gradient = torch.empty_like(pixels)
    scales = [1 / _at_least_one(channels * axis.counted) for axis in weights]
    sums = torch.zeros(math.ceil(height / STRIP_ROWS), width * channels, dtype=torch.float64)
    sum_differences(
        pixels.view(height, width * channels).numpy(),
        channels,
        *(
            pixels.new_empty(0, 0).numpy() if w is None else w.contiguous().numpy()
            for _, w in weights
        ),
        pixels.new_tensor(scales).numpy(),
        gradient.view(height, width * channels).numpy(),
        sums.numpy(),
    )
    return with_gradients(sums.sum().item(), [image], [gradient])


def _total_variation_on_gpu(image: Tensor, weights: Sequence[DifferenceWeights]) -> Tensor:
    from mrgs.method.gpu import total_variation as variation_on_device

    scaled, scales = [], []
    for counted, weight in weights:
        share = 1 / _at_least_one(image.shape[2] * counted)
        if isinstance(share, Tensor):  # only the device knows it
            assert weight is not None
            weight, share = weight * share, 1.0
        scaled.append(weight)
        scales.append(share)
    value, gradient = variation_on_device(image, (scaled[0], scaled[1]), (scales[0], scales[1]))
    return with_gradients(value, [image], [gradient])


def _at_least_one(count: int | Tensor) -> int | Tensor:
    return count.clamp_min(1) if isinstance(count, Tensor) else max(count, 1)


def _total_variation(image: Tensor, weights: Sequence[DifferenceWeights]) -> Tensor:
    """``total_variation`` in plain torch, for other devices; the fused kernels are tested against
    it."""
    total = image.new_zeros(())
    for axis, (counted, weight) in enumerate(weights):
        difference = image.diff(dim=axis).abs()
        weighted = difference if weight is None else weight[:, :, None] * difference
        total = total + weighted.sum() / _at_least_one(counted * image.shape[2])
    return total


def opaqueness_loss(
    alpha_thermal: Float[Tensor, "h w"],
    alpha_rgb: Float[Tensor, "h w"],
    depth_thermal: Float[Tensor, "h w"],
    depth_rgb: Float[Tensor, "h w"],
) -> Float[Tensor, ""]:
    """L_opaque: what blocks light blocks heat radiation too; not in the paper.

    The mean of max(0, α_c − α_t) + max(0, 1 − d_c / d_t), with d = D / α the depth of the surface:
    the thermal image may neither be more transparent than the colours nor look behind what they
    show. Without it a surface whose temperature is that of what lies behind it, or of the
    background, may as well be transparent. Glass, which lets light pass alone, is left free: α_c
    and d_c carry no gradient.

    Args:
        alpha_thermal: accumulated alpha of the thermal blend.
        alpha_rgb: of the RGB blend, by the same camera.
        depth_thermal: D_t, blended depth in scene units.
        depth_rgb: D_c.
    """
    alpha_rgb = alpha_rgb.detach()
    surface_rgb = depth_rgb.detach() / alpha_rgb.clamp_min(HALF_COVERED)
    surface_thermal = depth_thermal / alpha_thermal.clamp_min(HALF_COVERED)
    behind = (1 - surface_rgb / surface_thermal.clamp_min(SMALLEST_DEPTH)).relu()
    return (
        (alpha_rgb - alpha_thermal).relu() + torch.where(alpha_rgb >= HALF_COVERED, behind, 0)
    ).mean()


def total_loss(
    terms: Mapping[str, Float[Tensor, ""]], weights: Mapping[str, float]
) -> Float[Tensor, ""]:
    """Eq. 20 (final_loss), Sec. Total Loss: L_c + L_t + λ_smooth L_smooth + λ_boltz L_boltz.

    Args:
        terms: any of those that have a weight; what a view or a method lacks is left out.
        weights: by the names of the terms.

    Raises:
        KeyError: a term without a weight.
        ValueError: no term at all.
    """
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


def mean_weights(
    plane: Float[Tensor, "h w"], valid: Bool[Tensor, "h w"] | None
) -> Float[Tensor, "h2 w"]:
    """Each pixel's weight in ``masked_mean`` of a plane: [H, W], or [1, W] where all count
    alike."""
    if valid is None:
        return plane.new_full((1, plane.shape[1]), 1 / plane.numel())
    return valid.to(plane.dtype) / valid.sum().clamp_min(1)


def _planes(image: Float[Tensor, "h w c"]) -> Float[Tensor, "c h w"]:
    return image.permute(2, 0, 1).contiguous()
