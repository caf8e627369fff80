"""Operations of the method: one plain torch definition each, and kernels that compute it faster.

``@operation`` marks the plain definition, which is the one to read and to edit. A call looks for a
kernel that takes the device and the type of the tensors, among those that ``register_kernels`` was
given and then in the table of ``mrgs.kernels``, and runs the plain definition if there is none. At
the start of a training, and when a run is opened, every kernel in use is compared with its plain
definition (``checking``): where they differ, because someone has edited an equation and not yet its
kernel, the plain definition runs from then on.
"""

from __future__ import annotations

import importlib
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import fields, is_dataclass, replace
from functools import cache, partial, update_wrapper
from types import MethodType
from typing import Any, Concatenate, Generic, Literal, NamedTuple, ParamSpec, TypeVar, overload

import torch
from torch import Tensor, nn

from mrgs.errors import KernelWarning, warn_user
from mrgs.system import gpu

P = ParamSpec("P")
R = TypeVar("R")
S = TypeVar("S")
Q = ParamSpec("Q")

Device = Literal["cpu", "gpu"]

KERNEL_TABLE = "mrgs.kernels"
"""Module whose ``TABLE`` lists the kernels of the method. Named by a string and imported at the
first call of an operation, because kernels import the definitions that they replace."""

PLAIN_VARIABLE = "MRGS_PLAIN"
"""Environment variable; any value but 0 turns all kernels off."""


class Kernel(NamedTuple):
    """A kernel and the operation that it computes.

    Attributes:
        replaces: ``Operation.name``, the full name of the plain definition.
        function: the kernel, or its full name where its module is to be imported at the first call.
            It takes the operation's arguments, and may return NotImplemented for those that it does
            not handle.
        device: "gpu" for NVIDIA GPUs.
        dtypes: of the operation's first tensor.
    """

    replaces: str
    function: str | Callable[..., Any]
    device: Device
    dtypes: tuple[torch.dtype, ...] = (torch.float32,)


def register_kernels(*kernels: Kernel) -> None:
    """Make kernels known; each replaces a known one for the same operation and device."""
    _registered.update({(kernel.replaces, kernel.device): kernel for kernel in kernels})


class Operation(Generic[P, R]):
    """A function with a plain definition, whose full name it has, and, for some devices, a kernel;
    ``measure`` is what is compared of a result, from the result and the arguments, and ``rejected``
    are the kernels that were found to differ, so that they are not used."""

    __name__: str

    def __init__(self, plain: Callable[P, R], measure: Callable[..., Tensor] | None = None) -> None:
        update_wrapper(self, plain)
        self.plain = plain
        self.name = f"{plain.__module__}.{plain.__qualname__}"
        self.measure = measure
        self.rejected: set[Callable[..., Any]] = set()

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Compute the operation by a kernel if there is one, else by the plain definition."""
        kernel = self.kernel((*args, *kwargs.values()))
        check = _check.get()
        if kernel and check and (check.gradients or kernel not in self.rejected):
            self._compare(kernel, check, args, kwargs)
        if kernel is None or kernel in self.rejected:
            return self.plain(*args, **kwargs)
        result = kernel(*args, **kwargs)
        return self.plain(*args, **kwargs) if result is NotImplemented else result

    @overload
    def __get__(self, instance: None, owner: type) -> Operation[P, R]: ...
    @overload
    def __get__(
        self: Operation[Concatenate[S, Q], R], instance: S, owner: type
    ) -> Callable[Q, R]: ...
    def __get__(self, instance: Any, owner: type) -> Any:
        """As a method of an object; the operation itself as an attribute of the class."""
        return self if instance is None else MethodType(self, instance)

    def kernel(self, arguments: Sequence[Any]) -> Callable[..., Any] | None:
        """The kernel for these arguments, chosen by their first tensor; None if there is none."""
        tensor = _first_tensor(arguments)
        if tensor is None or kernels_disabled():
            return None
        if gpu.runs_triton(tensor):
            return self.listed("gpu", tensor.dtype)
        return self.listed("cpu", tensor.dtype) if tensor.is_cpu else None

    def listed(self, device: Device, dtype: torch.dtype) -> Callable[..., Any] | None:
        """The kernel for a device and a type; None if there is none."""
        entry = _registered.get((self.name, device)) or _table().get((self.name, device))
        if entry is None or dtype not in entry.dtypes:
            return None
        return _imported(entry.function) if isinstance(entry.function, str) else entry.function

    def _compare(self, kernel: Callable[..., Any], check: _Check, args: Any, kwargs: Any) -> None:
        """Compare the kernel with the plain definition; a warning where it is rejected."""
        comparison = KernelComparison(self.plain, self.measure, check.gradients)
        problem = comparison.problem_of(kernel, args, kwargs)
        if problem is None:
            if kernel not in check.rejected:
                self.rejected.discard(kernel)
            return
        self.rejected.add(kernel)
        if kernel not in check.rejected:
            check.rejected.add(kernel)
            warn_user(
                f"{self.__name__}: the kernel {problem}; the plain definition is used, slower",
                KernelWarning,
            )


@overload
def operation(plain: Callable[P, R]) -> Operation[P, R]: ...
@overload
def operation(*, measure: Callable[..., Tensor]) -> Callable[[Callable[P, R]], Operation[P, R]]: ...
def operation(plain: Any = None, *, measure: Any = None) -> Any:
    """Mark the plain definition of an operation, which kernels may replace; ``measure`` turns a
    result and the arguments into what a check compares, for results with several forms."""
    return partial(Operation, measure=measure) if plain is None else Operation(plain, measure)


def kernels_disabled() -> bool:
    """Whether ``disable_kernels`` or the environment variable MRGS_PLAIN turns kernels off."""
    return _disabling > 0 or os.environ.get(PLAIN_VARIABLE, "0") not in ("", "0")


@contextmanager
def disable_kernels(really: bool = True) -> Iterator[None]:
    """Within this block no thread of the process uses a kernel, if ``really``."""
    global _disabling
    _disabling += really
    try:
        yield
    finally:
        _disabling -= really


@contextmanager
def checking(gradients: bool = True) -> Iterator[None]:
    """Within this block every kernel is compared with its plain definition before it is used.

    Both compute the operation from the same inputs; results and gradients (for the same random
    cotangents; not without ``gradients``) may differ by ``TOLERANCE``, as a
    relative L2 norm. A kernel that differs is not used from then on in this process, unless it
    passes a later check with gradients; one without skips it. torch's random generators are left
    alone. KernelWarning if a kernel differs from its plain definition, or fails."""
    token = _check.set(_Check(gradients, set()))
    try:
        yield
    finally:
        _check.reset(token)


class _Check(NamedTuple):
    """A block of ``checking``: what it compares, and the kernels that it rejected."""

    gradients: bool
    rejected: set[Callable[..., Any]]


_disabling = 0
_registered: dict[tuple[str, Device], Kernel] = {}
_check: ContextVar[_Check | None] = ContextVar("mrgs_check", default=None)


@cache
def _table() -> dict[tuple[str, Device], Kernel]:
    kernels: Sequence[Kernel] = importlib.import_module(KERNEL_TABLE).TABLE
    return {(kernel.replaces, kernel.device): kernel for kernel in kernels}


@cache
def _imported(name: str) -> Callable[..., Any]:
    module, _, function = name.rpartition(".")
    found: Callable[..., Any] = getattr(importlib.import_module(module), function)
    return found


def _first_tensor(values: Iterable[Any]) -> Tensor | None:
    """The first tensor among values, or in a tuple, list or dataclass among them."""
    for value in values:
        if isinstance(value, Tensor):
            return value
        found = _first_tensor(members(value))
        if found is not None:
            return found
    return None


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
