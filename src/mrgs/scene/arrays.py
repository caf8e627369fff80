"""Arrays of callers: NumPy arrays, tensors or nested lists."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, SupportsIndex, TypeAlias

import numpy as np
import torch
from jaxtyping import Float64
from numpy.typing import NDArray
from torch import Tensor

from mrgs.errors import ConfigError
from mrgs.system.strict_yaml import whole_number

Array: TypeAlias = Tensor | NDArray[Any] | Sequence[Any]
"""What public functions accept for an array. Masked elements (``np.ma``) count as NaN."""

_COMPUTABLE = {torch.uint16: torch.int32, torch.uint32: torch.int64, torch.uint64: torch.float64}
"""Types that torch stores but hardly computes with, and what holds their values."""

Numbers: TypeAlias = tuple["float | Numbers", ...]


def constant(values: Numbers, like: Tensor) -> Tensor:
    """A few numbers as a tensor of the type and on the device of another; not to be changed, and
    not for passes that are recorded.

    Made once for each device: to copy something to a GPU waits for all that is queued there.
    """
    return _constant(values, like.dtype, like.device)


@lru_cache(maxsize=1024)
def _constant(values: Numbers, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=torch.float64, device="cpu").to(device, dtype)


def as_tensor(
    array: Array, dtype: torch.dtype | None, shape: tuple[int | None, ...], name: str
) -> Tensor:
    """An array as a tensor in main memory; the caller's own memory where dtype and place allow.
    ValueError for another shape, and for anything but real numbers.

    Args:
        array: of numbers; an empty list has no rows.
        dtype: of the tensor; None keeps the array's, where torch computes with it.
        shape: expected; None for any length.
    """
    values = _tensor_of(array, name)
    if values.shape == (0,) and shape[0] is None:
        values = values.reshape([length or 0 for length in shape])
    if len(values.shape) != len(shape) or any(
        want not in (None, have) for want, have in zip(shape, values.shape, strict=True)
    ):
        expected = ", ".join("any" if length is None else str(length) for length in shape)
        raise ValueError(f"{name} must have shape [{expected}], not {list(values.shape)}")
    return values.detach().to("cpu", dtype or values.dtype)


def as_finite(array: Array, shape: tuple[int | None, ...], name: str) -> Float64[Tensor, "..."]:
    """``as_tensor`` in float64, of finite numbers. ValueError for another shape, and for numbers
    that are not finite."""
    values = as_tensor(array, torch.float64, shape, name)
    if not np.isfinite(values.numpy()).all():  # torch takes four times as long for a few numbers
        raise ValueError(f"{name} holds NaN or infinity")
    return values


def as_floats(array: Array | float, name: str, last: int | None = None) -> Tensor:
    """An array to compute with: a tensor of floats as it is, on its device and with its gradient;
    integers as float64. ValueError for another length, and for anything but real numbers.

    Args:
        array: of numbers; an empty list has no rows.
        last: expected length of the last axis; None for any shape.
    """
    values = _tensor_of(array, name)
    if last is not None and values.shape == (0,):
        values = values.reshape(0, last)
    if last is not None and values.shape[-1:] != (last,):
        raise ValueError(f"{name} must have shape [..., {last}], not {list(values.shape)}")
    return values if values.is_floating_point() else values.double()


def as_whole(value: SupportsIndex, name: str) -> int:
    """``whole_number`` with the error of an argument that describes a scene. ValueError for
    anything else, such as 64.0."""
    try:
        return whole_number(value, name)
    except ConfigError as error:
        raise ValueError(error.message) from None


def _tensor_of(array: Array | float, name: str) -> Tensor:
    """A tensor that torch can compute with."""
    try:
        values = array if isinstance(array, Tensor) else torch.from_numpy(_plain(array))
    except (TypeError, ValueError):  # of objects, or of rows that differ in length
        raise ValueError(f"{name} must be an array of numbers, its rows of one length") from None
    if values.is_complex():
        raise ValueError(f"{name} must be an array of real numbers, not complex ones")
    return values.to(_COMPUTABLE.get(values.dtype, values.dtype))


def _plain(array: NDArray[Any] | Sequence[Any] | float) -> NDArray[Any]:
    """An array that torch can share: in order, writable, of the machine's byte order, unmasked."""
    try:
        values = np.asanyarray(array)
    except (RuntimeError, TypeError):  # of a list with tensors that have gradients, or on a GPU
        values = np.asanyarray(_on_host(array))
    if isinstance(values, np.ma.MaskedArray):
        floats = np.result_type(values, np.float32)
        values = np.ma.filled(values.astype(floats), np.nan)
    if values.dtype == np.longdouble:
        values = values.astype(np.float64)
    values = np.require(values, values.dtype.newbyteorder("="), ["C", "W"])
    return values if all(stride >= 0 for stride in values.strides) else values.copy()


def _on_host(nested: Any) -> Any:
    if isinstance(nested, Tensor):
        return nested.detach().cpu().numpy()
    return [_on_host(each) for each in nested] if isinstance(nested, (list, tuple)) else nested
