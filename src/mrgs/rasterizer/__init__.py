"""Alpha blending of projected Gaussians: the contract, the oracle, and the kernels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.rasterizer import cpu, reference
from mrgs.rasterizer.contract import Blend, Layer, Raster, Rasterizer
from mrgs.system.gpu import serves

__all__ = ["Blend", "Layer", "Raster", "rasterize"]


def rasterize(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    layers: Sequence[Layer],
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
    means2d_offset: Float[Tensor, "n 2"] | None = None,
) -> Raster:
    """``contract.Rasterizer``: the kernels for float32 tensors on a GPU or the CPU, the oracle for
    everything else."""
    chosen = _kernels_for(means) or reference.rasterize
    return chosen(means, quats, scales, layers, viewmat, K, width, height, means2d_offset)


def _kernels_for(means: Tensor) -> Rasterizer | None:
    if serves(means):
        from mrgs.rasterizer import gpu  # only here: it imports Triton

        return gpu.rasterize
    if means.device.type == "cpu" and means.dtype == torch.float32:
        return cpu.rasterize
    return None
