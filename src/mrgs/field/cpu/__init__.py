"""The field's two heads as fused Numba kernels for float32 on the CPU, each with its analytic
gradient.

The plain torch code of ``mrgs.field`` is the definition; the tests hold these kernels against it.
"""

import torch
from torch import Tensor

from mrgs.field.cpu.color_head import color_residual
from mrgs.field.cpu.harmonics import shade
from mrgs.field.cpu.heat import refine, with_neighbours
from mrgs.field.cpu.small_product import product
from mrgs.field.cpu.thermal_head import project_features

__all__ = [
    "color_residual",
    "product",
    "project_features",
    "refine",
    "serves",
    "shade",
    "with_neighbours",
]


def serves(tensor: Tensor) -> bool:
    """Whether the kernels take tensors of this device and type."""
    return tensor.device.type == "cpu" and tensor.dtype == torch.float32
