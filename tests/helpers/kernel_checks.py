"""Kernels are compared with their definitions once per process for each form of the arguments."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import wraps
from typing import Any

from torch import Tensor, nn

from mrgs.system.operation import Operation, members


def form_of(value: Any) -> Hashable:
    """Types and settings; of tensors neither the numbers nor the sizes."""
    if isinstance(value, Tensor):
        empty = value.numel() == 0
        return value.dtype, value.dim(), empty, value.device, value.requires_grad
    if isinstance(value, nn.Module):  # its own repr has the settings of the layers
        settings = repr(value), repr(getattr(value, "config", None))
        return type(value), settings, form_of(dict(value.named_parameters()))
    if isinstance(value, (bool, int, float, str, type(None))):
        return value
    if isinstance(value, dict):
        return tuple((str(name), form_of(each)) for name, each in value.items())
    return type(value), tuple(map(form_of, members(value)))


def once_per_form(compare: Callable[..., None]) -> Callable[..., None]:
    """``Operation._compare``, which leaves out what it has already found equal."""
    equal: set[Hashable] = set()

    @wraps(compare)
    def compared(operation: Operation, kernel: Any, check: Any, args: Any, kwargs: Any) -> None:
        form = operation, kernel, check.gradients, form_of(args), form_of(kwargs)
        if form in equal:
            return
        compare(operation, kernel, check, args, kwargs)
        if kernel not in operation.rejected:
            equal.add(form)

    return compared
