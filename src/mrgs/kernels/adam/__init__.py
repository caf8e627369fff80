"""Adam's step of several tensors by torch's fused kernel, on any device."""

from __future__ import annotations

import torch
from torch import Tensor

from mrgs.method.adam import BETA1, BETA2


def move(
    parameters: list[Tensor],
    gradients: list[Tensor],
    means: list[Tensor],
    squares: list[Tensor],
    counts: list[Tensor],
    rate: float,
    epsilon: float,
    skip: Tensor | None,
) -> None:
    """``mrgs.method.adam.move`` for tensors of one type on one device."""
    torch._fused_adam_(
        parameters, gradients, means, squares, [], counts,
        lr=rate, beta1=BETA1, beta2=BETA2, weight_decay=0.0, eps=epsilon, amsgrad=False,
        maximize=False, grad_scale=None, found_inf=skip,
    )  # fmt: skip
