"""Products of the layers' own matrices, which are too small for threads."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mrgs.kernels.dense.product import TILE_COLUMNS, TILE_ROWS, multiply, panels, rounded_up


def product(a: Float[Tensor, "m k"], b: Float[Tensor, "k n"]) -> Float[Tensor, "m n"]:
    """a · b for float32 on the CPU; a library's product of some shapes depends on the number of
    threads."""
    result: Tensor = _Product.apply(a, b)
    return result


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        ctx.save_for_backward(a, b)
        return _multiplied(a, b)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        a, b = ctx.saved_tensors
        return _multiplied(grads[0], b.T), _multiplied(a.T, grads[0])


def _multiplied(a: Tensor, b: Tensor) -> Tensor:
    (rows, k), columns = a.shape, b.shape[1]
    left = np.zeros((rounded_up(rows, TILE_ROWS), k), np.float32)
    left[:rows] = a.detach().numpy()
    width = rounded_up(columns, TILE_COLUMNS)
    out = np.empty((len(left), width), np.float32)
    multiply(left, panels(b.detach().numpy()), np.zeros(width, np.float32), out)
    return torch.from_numpy(out[:rows, :columns].copy())
