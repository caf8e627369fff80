"""The losses that compare images, for float32 and float64 on the CPU."""

from __future__ import annotations

import math
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.kernels.require import require
from mrgs.kernels.ssim import compare_cpu, losses
from mrgs.kernels.ssim.compare_cpu import STRIP_ROWS, TAPS
from mrgs.kernels.ssim.losses import Dissimilarity
from mrgs.method.losses.ssim import WEIGHTS


def compare(
    x: Float[Tensor, "h w c"],
    y: Float[Tensor, "h w c"],
    weights: Float[Tensor, "h2 w"],
    scalars: tuple[float, float, float, float, float, float],
    wants_errors: bool,
) -> Dissimilarity:
    """``losses.Compare``.

    Raises:
        ValueError: tensors of other sizes or types.
    """
    require("x", x, (None, None, None), (torch.float32, torch.float64))
    require("y", y, x.shape, (x.dtype,))
    height, width, channels = x.shape
    require("weights", weights, (1 if len(weights) == 1 else height, width), (x.dtype,))
    in_memory = (height, width * channels)
    errors = x.new_empty(x.shape if wants_errors else (0, 0))
    gradients = [x.new_empty(in_memory if tensor.requires_grad else (0, 0)) for tensor in (x, y)]
    sums = torch.zeros(math.ceil(height / STRIP_ROWS), width * channels, dtype=torch.float64)
    compare_cpu.compare(
        compare_cpu.ImagePair(
            x=x.detach().reshape(in_memory).contiguous().numpy(),
            y=y.detach().reshape(in_memory).contiguous().numpy(),
            weights=weights.detach().repeat_interleave(channels, dim=1).numpy(),
            channels=channels,
            window=WEIGHTS[: TAPS // 2 + 1].to(x.dtype).numpy(),
            scalars=x.new_tensor(scalars).numpy(),
            grad_x=gradients[0].numpy(),
            grad_y=gradients[1].numpy(),
            errors=errors.flatten(1).numpy(),
            sums=sums.numpy(),
        )
    )
    grad_x, grad_y = (tensor.view(x.shape) if tensor.numel() else None for tensor in gradients)
    return Dissimilarity(sums.sum().item(), grad_x, grad_y, errors if wants_errors else None)


photometric_loss = partial(losses.photometric_loss, compare)
boltzmann_loss = partial(losses.boltzmann_loss, compare)
