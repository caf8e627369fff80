"""Arrays of callers: NumPy arrays, tensors or nested lists."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array: TypeAlias = Tensor | NDArray[Any] | Sequence[Any]
"""What public functions accept for an array."""


def as_tensor(
    array: Array, dtype: torch.dtype | None, shape: tuple[int | None, ...], name: str
) -> Tensor:
    """An array as a tensor in main memory; the caller's own memory where dtype and place allow.

    Args:
        array: of numbers.
        dtype: of the tensor; None keeps the array's.
        shape: expected; None for any length.
        name: of the array, for the message.

    Raises:
        ValueError: another shape, or not numbers.
    """
    try:
        values = array if isinstance(array, Tensor) else torch.from_numpy(_plain(array))
    except TypeError:
        raise ValueError(f"{name} must be an array of numbers") from None
    if len(values.shape) != len(shape) or any(
        want not in (None, have) for want, have in zip(shape, values.shape, strict=True)
    ):
        expected = ", ".join("any" if length is None else str(length) for length in shape)
        raise ValueError(f"{name} must have shape [{expected}], not {list(values.shape)}")
    return values.detach().to("cpu", dtype or values.dtype)


def _plain(array: NDArray[Any] | Sequence[Any]) -> NDArray[Any]:
    """An array that torch can share: in order, and writable."""
    values = np.ascontiguousarray(array)
    return values if values.flags.writeable else values.copy()
