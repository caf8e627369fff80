"""Comparison of a kernel with the plain definition that it replaces: results and gradients."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

TOLERANCE = 1e-3
"""Relative error up to which a kernel counts as equal to its plain definition."""

SMALL_GRADIENT = 1e-2
"""A gradient below this share of the operation's largest is compared with that share: one that
vanishes, such as that of a ball's rotation, is rounding noise."""

NUDGES = 3
NUDGE = 1e-2
"""A kernel that differs is compared again with its inputs changed by about this share, and is
rejected if it differs each time."""

SMALLEST = 1e-30
"""Divides where a result vanishes."""


class KernelComparison(NamedTuple):
    """What kernels of an operation are compared with, and how: by the operation's ``measure``, None
    for all of a result; and whether by ``gradients`` as well."""

    plain: Callable[..., Any]
    measure: Callable[..., Tensor] | None
    gradients: bool

    def problem_of(
        self, kernel: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> str | None:
        """Why a kernel is rejected; None if it equals the plain definition."""
        error, problem = self._difference(kernel, args, kwargs)
        generator = torch.Generator().manual_seed(0)
        for _ in range(NUDGES):
            if error <= TOLERANCE:
                break
            # At the kink of a clamp, rounding decides on which side of it a value lies.
            nudged_args, nudged_kwargs = (_nudged(values, generator) for values in (args, kwargs))
            error, problem = self._difference(kernel, nudged_args, nudged_kwargs)
        return None if error <= TOLERANCE else problem

    def _difference(
        self, kernel: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> tuple[float, str]:
        """Relative error of the kernel, and a description of it."""
        expected = self._outcome(self.plain, args, kwargs)
        try:
            error = _relative_error(self._outcome(kernel, args, kwargs), expected)
        except Exception as failure:  # a kernel may do anything with arguments new to it
            problem = f"fails where the plain definition runs ({type(failure).__name__}: {failure})"
            return math.inf, problem
        return error, f"differs from the plain definition (relative error {error:.2g})"

    def _outcome(
        self, function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> _Outcome | None:
        """What a function makes of copies of the arguments; None if it does not handle them."""
        args, kwargs = _copied(args), _copied(kwargs)
        inputs = [
            tensor for tensor in _tensors((args, list(kwargs.values()))) if tensor.requires_grad
        ]
        with torch.set_grad_enabled(self.gradients):
            result = function(*args, **kwargs)
        if result is NotImplemented:
            return None
        if self.measure is not None:
            result = self.measure(result, *args, **kwargs)
        results = list(_tensors(result))
        if not self.gradients:
            return _Outcome(results, [])
        generator = torch.Generator().manual_seed(0)
        pairs = [
            (tensor, torch.randn(tensor.shape, generator=generator, dtype=tensor.dtype))
            for tensor in results
        ]
        depend = [(each, cotangent.to(each)) for each, cotangent in pairs if each.requires_grad]
        gradients = [torch.zeros_like(tensor) for tensor in inputs]
        if depend and inputs:
            outputs, cotangents = zip(*depend, strict=True)
            gradients = list(
                torch.autograd.grad(outputs, inputs, cotangents, materialize_grads=True)
            )
        return _Outcome([tensor.detach() for tensor in results], gradients)


def members(value: Any) -> Iterable[Any]:
    """The members of a tuple, list or dataclass; none of any other value."""
    if isinstance(value, (list, tuple)):
        return value
    return vars(value).values() if is_dataclass(value) else ()


class _Outcome(NamedTuple):
    """Results of an operation, and the gradients of its inputs for cotangents of the results."""

    results: list[Tensor]
    gradients: list[Tensor]


def _copied(value: Any, change: Callable[[Tensor], Tensor] = Tensor.clone) -> Any:
    """The value with copies of its tensors, cut from their graph; modules stay as they are."""
    if isinstance(value, Tensor):
        return change(value.detach()).requires_grad_(value.requires_grad)
    if isinstance(value, (list, tuple)):
        copies = [_copied(member, change) for member in value]
        return type(value)(*copies) if hasattr(value, "_fields") else type(value)(copies)
    if isinstance(value, dict):
        return {name: _copied(member, change) for name, member in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in fields(value) if field.init]
        return replace(value, **{name: _copied(getattr(value, name), change) for name in names})
    return value


def _nudged(value: Any, generator: torch.Generator) -> Any:
    """The value with its floating-point tensors changed a little, at random."""

    def change(tensor: Tensor) -> Tensor:
        if not tensor.is_floating_point():
            return tensor.clone()
        noise = torch.randn(tensor.shape, generator=generator, dtype=tensor.dtype)
        return tensor * (1 + NUDGE * noise.to(tensor.device))

    return _copied(value, change)


def _tensors(value: Any) -> Iterator[Tensor]:
    """Floating-point tensors in a value, parameters of modules included."""
    if isinstance(value, Tensor):
        if value.is_floating_point():
            yield value
    elif isinstance(value, nn.Module):
        yield from value.parameters()
    else:
        for member in members(value):
            yield from _tensors(member)


def _relative_error(found: _Outcome | None, expected: _Outcome | None) -> float:
    """The largest relative L2 error of a result or a gradient; infinite if their shapes differ."""
    if found is None or expected is None:
        return 0.0
    if [t.shape for t in found.results] != [t.shape for t in expected.results]:
        return math.inf
    norms = [tensor.norm().item() for tensor in expected.gradients]
    floor = SMALL_GRADIENT * max(norms, default=0.0)
    errors = [
        _distance(a, b) / max(b.norm().item(), SMALLEST)
        for a, b in zip(found.results, expected.results, strict=True)
    ]
    errors += [
        _distance(a, b) / max(norm, floor, SMALLEST)
        for a, b, norm in zip(found.gradients, expected.gradients, norms, strict=True)
    ]
    return max(errors, default=0.0)


def _distance(a: Tensor, b: Tensor) -> float:
    """L2 norm of the difference; infinite where only one of the two is not a number."""
    is_same = (a == b) | (a.isnan() & b.isnan())
    return torch.where(is_same, 0, a - b).nan_to_num(math.inf).norm().item()
