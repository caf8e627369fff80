"""Rows of Gaussians, listed as kernels take them."""

from __future__ import annotations

import torch
from torch import Tensor

from mrgs.kernels.require import require_indices


def listed(rows: Tensor | None, count: int) -> Tensor:
    """The rows, on the CPU; all ``count`` of them if None.

    Raises:
        ValueError: not a list of int64.
        IndexError: rows that do not exist.
    """
    if rows is None:
        return torch.arange(count)
    require_indices("rows", rows, (None,), count)
    return rows
