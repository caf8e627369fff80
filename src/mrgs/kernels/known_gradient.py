"""Losses whose gradients are computed together with their value."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable


def with_gradients(
    value: float | Float[Tensor, ""], inputs: Sequence[Tensor], gradients: Sequence[Tensor | None]
) -> Float[Tensor, ""]:
    """A loss of known value and known gradients, for autograd; it can be differentiated once.

    Args:
        value: of the loss; a tensor on the inputs' device where the host should not wait for it.
        inputs: what it depends on; the first decides on type and device.
        gradients: by each of the inputs; None where none is wanted.
    """
    result: Tensor = _KnownGradients.apply(value, gradients, *inputs)
    return result


class _KnownGradients(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, value: float | Tensor, gradients: Sequence[Tensor | None], *inputs: Tensor
    ) -> Tensor:
        ctx.save_for_backward(*gradients)
        if isinstance(value, Tensor):
            return value.detach().to(inputs[0], copy=True)
        return inputs[0].new_tensor(value)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, scale: Tensor) -> tuple[Tensor | None, ...]:
        gradients = [
            None if gradient is None else scale * gradient for gradient in ctx.saved_tensors
        ]
        return (None, None, *gradients)
