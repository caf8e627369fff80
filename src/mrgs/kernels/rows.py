"""Rows of Gaussians, listed as kernels take them."""

from __future__ import annotations

import torch
from torch import Tensor


def listed(rows: Tensor | None, count: int) -> Tensor:
    """The rows, on the CPU; all ``count`` of them if None."""
    return torch.arange(count) if rows is None else rows
