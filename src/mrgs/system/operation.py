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
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, partial, update_wrapper
from types import MethodType
from typing import Any, Concatenate, Generic, Literal, NamedTuple, ParamSpec, TypeVar, overload

import torch
from torch import Tensor

from mrgs.errors import KernelWarning, warn_user
from mrgs.system import gpu
from mrgs.system.operation_check import KernelComparison, members

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
    result and the arguments into what a check compares, for results that can be written in several
    ways."""
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
    cotangents; not without ``gradients``) may differ by ``operation_check.TOLERANCE``, as a
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
