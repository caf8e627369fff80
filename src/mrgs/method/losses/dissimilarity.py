"""The fused kernels of L1, SSIM and S-SSIM, for torch tensors on the CPU or on a GPU."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.method.cpu.dissimilarity import STRIP_ROWS, TAPS, Comparison, compare
from mrgs.method.losses.ssim import K1, K2, STRUCTURE_C2, WEIGHTS
from mrgs.system import gpu

STRUCTURE_C1 = 1e20
"""Next to this C1 the means do not count: SSIM's luminance term is 1, which leaves the structure
term, S-SSIM."""


class Dissimilarity(NamedTuple):
    """Two images compared.

    Attributes:
        total: the weighted sum over all values; on a GPU a tensor that stays there, so that nobody
            waits for it.
        grad_x: its gradient by x, [H, W, C]; None unless x asks for one.
        grad_y: its gradient by y; likewise.
    """

    total: float | Float[Tensor, ""]
    grad_x: Float[Tensor, "h w c"] | None
    grad_y: Float[Tensor, "h w c"] | None


def serves(tensor: Tensor) -> bool:
    """Whether there is a fused kernel for this tensor: float32 or float64 on the CPU, float32 on a
    GPU."""
    return tensor.device.type == "cpu" or gpu.serves(tensor)


def l1_dssim(
    x: Float[Tensor, "h w c"],
    y: Float[Tensor, "h w c"],
    weights: Float[Tensor, "h2 w"],
    dssim: float,
) -> Dissimilarity:
    """Σ weights ((1 − dssim) |x − y| + dssim (1 − SSIM)) with ``ssim.ssim_map`` at a data range of
    1.

    Args:
        x: an image that ``serves`` says yes to.
        y: the image to compare with.
        weights: of each pixel, [H, W], or [1, W] for all rows alike; where 0, both images are read
            as 0.
        dssim: λ.
    """
    return _compare(x, y, weights, (dssim, 1 - dssim, K1**2, K2**2), False)[0]


def structural_dissimilarity(
    x: Float[Tensor, "h w c"], y: Float[Tensor, "h w c"], weights: Float[Tensor, "h2 w"]
) -> tuple[Dissimilarity, Float[Tensor, "h w c"]]:
    """Σ weights (1 − S-SSIM) with ``ssim.structural_similarity``, and 1 − S-SSIM of each value.

    The arguments are those of ``l1_dssim``.
    """
    result, errors = _compare(x, y, weights, (1.0, 0.0, STRUCTURE_C1, STRUCTURE_C2), True)
    assert errors is not None
    return result, errors


def _compare(
    x: Tensor,
    y: Tensor,
    weights: Tensor,
    scalars: tuple[float, float, float, float],
    wants_errors: bool,
) -> tuple[Dissimilarity, Tensor | None]:
    """What the device's kernel finds, and 1 − SSIM of each value if that is wanted."""
    if gpu.serves(x):
        from mrgs.method.gpu import compare as compare_on_device

        found = compare_on_device(x, y, weights, scalars, y.requires_grad, wants_errors)
        grad_x = found.gradient_x if x.requires_grad else None
        return Dissimilarity(found.total, grad_x, found.gradient_y), found.errors
    errors = x.new_empty(x.shape if wants_errors else (0, 0))
    result = _compare_on_cpu(x, y, weights, list(scalars), errors.flatten(1))
    return result, errors if wants_errors else None


def _compare_on_cpu(
    x: Tensor, y: Tensor, weights: Tensor, scalars: list[float], errors: Tensor
) -> Dissimilarity:
    """Call the kernel; ``errors`` is filled unless it is empty."""
    height, width, channels = x.shape
    in_memory = (height, width * channels)
    gradients = [x.new_empty(in_memory if tensor.requires_grad else (0, 0)) for tensor in (x, y)]
    sums = torch.zeros(math.ceil(height / STRIP_ROWS), width * channels, dtype=torch.float64)
    compare(
        Comparison(
            x=x.detach().reshape(in_memory).contiguous().numpy(),
            y=y.detach().reshape(in_memory).contiguous().numpy(),
            weights=weights.detach().repeat_interleave(channels, dim=1).numpy(),
            channels=channels,
            window=WEIGHTS[: TAPS // 2 + 1].to(x.dtype).numpy(),
            scalars=x.new_tensor(scalars).numpy(),
            grad_x=gradients[0].numpy(),
            grad_y=gradients[1].numpy(),
            errors=errors.numpy(),
            sums=sums.numpy(),
        )
    )
    return Dissimilarity(
        sums.sum().item(),
        *(tensor.view(x.shape) if tensor.numel() else None for tensor in gradients),
    )
