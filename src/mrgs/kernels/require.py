"""Checks at the entry of a kernel: inside, sizes, types and indices are trusted."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mrgs.system.gpu import HOST


def require(
    name: str,
    tensor: Tensor,
    shape: Sequence[int | None],
    dtypes: Sequence[torch.dtype] = (torch.float32,),
    device: torch.device = HOST,
) -> None:
    """A tensor must have a shape, of which None allows any size, one of the types, and be on a
    device; ValueError with its name if it is not so."""
    fits = tensor.dim() == len(shape) and all(
        size is None or size == found for size, found in zip(shape, tensor.shape, strict=True)
    )
    if not fits or tensor.dtype not in dtypes or tensor.device != device:
        sizes = ", ".join("any" if size is None else str(size) for size in shape)
        types = " or ".join(_short(dtype) for dtype in dtypes)
        raise ValueError(
            f"{name} must be {types} [{sizes}] on {device}, not {_short(tensor.dtype)} "
            f"{list(tensor.shape)} on {tensor.device}"
        )


def require_indices(name: str, indices: Tensor, shape: Sequence[int | None], count: int) -> None:
    """A tensor must hold int64 indices of ``count`` rows. ValueError if it is of another shape or
    type; IndexError if an index is negative, or not below ``count``."""
    require(name, indices, shape, (torch.int64,))
    if indices.numel() == 0:
        return
    lowest, highest = indices.aminmax()
    if lowest < 0 or highest >= count:
        raise IndexError(
            f"{name} must lie in 0 to {count - 1}, but reach from {lowest} to {highest}"
        )


def require_layers(name: str, layers: Sequence[Tensor], widths: Sequence[int | None]) -> None:
    """Weight [out, in] and bias [out] of linear layers, in float32, must pass on what the layer
    before them gives: ``widths`` are those of the inputs and of each layer's outputs, and None
    allows any. ValueError with the network's name if they do not."""
    inputs = widths[0]
    for place, outputs in enumerate(widths[1:]):
        weight, bias = layers[2 * place], layers[2 * place + 1]
        require(f"{name}'s weight {place}", weight, (outputs, inputs))
        require(f"{name}'s bias {place}", bias, (len(weight),))
        inputs = len(weight)


def _short(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def listed(rows: Tensor | None, count: int) -> Tensor:
    """The rows, on the CPU; all ``count`` of them if None. ValueError if they are not a list of
    int64, IndexError for rows that do not exist."""
    if rows is None:
        return torch.arange(count)
    require_indices("rows", rows, (None,), count)
    return rows
