"""Every specialisation of the kernels that is launched, with the constants of its launch.

The launches read these entries, so that what is compiled ahead of time is what runs.
"""

from __future__ import annotations

from typing import Any

import torch

from mrgs.kernels.gpu_spec import KernelSpec
from mrgs.kernels.rasterize.gpu.blend import blend
from mrgs.kernels.rasterize.gpu.blend_backward import blend_backward, sum_pairs
from mrgs.kernels.rasterize.gpu.projection import project
from mrgs.kernels.rasterize.gpu.projection_backward import project_backward
from mrgs.kernels.rasterize.gpu.tiles import list_pairs

LEFT_OUT = {"fused": None, "color": "scalar", "scalar": "color"}
"""The layers that a pass may have, and which layer it then lacks."""

BLOCK = 128
"""Gaussians, or pairs, of one program: one per thread."""

RANKS = 4
PAIRS = 16
"""Ranks of one program of ``sum_pairs``, and pairs of each that it adds in one turn."""

_TYPES = {
    "pair_counts": "*i32", "splat_of_pair": "*i32", "tile_splats": "*i32", "tile_starts": "*i32",
    "order": "*i64", "pair_ends": "*i64", "tile_pairs": "*i64",
    "count": "i32", "pairs": "i32", "tiles": "i32", "width": "i32", "height": "i32",
    "dilation": "fp32",
}  # fmt: skip
"""Types of the arguments, by name; all others are tensors of float32."""


def _spec(
    kernel: Any, variant: str, num_warps: int, constants: dict[str, Any], **types: str
) -> KernelSpec:
    """An entry; of one stage, for there are no loads that Triton could fetch ahead: the walks do
    that themselves."""
    types = _TYPES | types
    signature = {
        name: types.get(name, "*fp32") for name in kernel.arg_names if name not in constants
    }
    return KernelSpec(kernel, signature, constants, num_warps, 1, variant)


def _layer_constants(kernel: Any, layers: str) -> dict[str, Any]:
    """Which layers the specialisation has; the tensors of one that it lacks are None."""
    left_out = LEFT_OUT[layers]
    tensors = {
        name: None for name in kernel.arg_names if left_out and name.endswith(f"_{left_out}")
    }
    return {"HAS_COLOR": left_out != "color", "HAS_SCALAR": left_out != "scalar", **tensors}


def _blends(kernel: Any) -> dict[str, KernelSpec]:
    """The entries of a kernel that walks the lists, by layers: one warp per tile."""
    return {
        layers: _spec(kernel, layers, 1, _layer_constants(kernel, layers)) for layers in LEFT_OUT
    }


def _projections(kernel: Any) -> dict[str, KernelSpec]:
    """The entries of a kernel that takes one Gaussian per thread, by layers."""
    return {
        layers: _spec(
            kernel, layers, BLOCK // 32, {**_layer_constants(kernel, layers), "BLOCK": BLOCK}
        )
        for layers in LEFT_OUT
    }


PROJECT = _projections(project)
LIST_PAIRS = {
    dtype: _spec(list_pairs, name, BLOCK // 32, {"BLOCK": BLOCK}, tile_of_pair=f"*{name}")
    for dtype, name in ((torch.int16, "i16"), (torch.int32, "i32"))
}
BLEND = _blends(blend)
BLEND_BACKWARD = _blends(blend_backward)
SUM_PAIRS = _spec(sum_pairs, "", 1, {"RANKS": RANKS, "PAIRS": PAIRS})
PROJECT_BACKWARD = _projections(project_backward)

KERNELS: tuple[KernelSpec, ...] = (
    *PROJECT.values(),
    *LIST_PAIRS.values(),
    *BLEND.values(),
    *BLEND_BACKWARD.values(),
    SUM_PAIRS,
    *PROJECT_BACKWARD.values(),
)
