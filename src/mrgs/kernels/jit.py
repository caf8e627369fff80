"""How the Numba kernels are compiled: on first call and kept on disk; division by zero gives inf.

Python calls kernels, and kernels call inner functions. These are kept as parts of their kernels,
and compiled without what Python would need to call them, which takes a fifth of all compiling.

Three arithmetics, each for parallel kernels, kernels and inner functions:

- ``strict``: as IEEE 754 has it, operation by operation.
- without a prefix: a multiplication and an addition may become one operation (contract).
- ``reordering``: the compiler may also reorder sums, so that it can use vectors (reassoc). The
  order is fixed in the compiled code, and so are the bits. NaN and infinity are kept.

``inlined`` functions become part of their kernel. Of others each kernel that calls them holds a
copy, optimised once more, and a process that compiles runs the first copy while one that loads
kernels from disk runs the kernel's own: where the two are optimised otherwise, bits differ. They
did in the heads, whose functions are therefore inlined; the other kernels' copies have agreed so
far.

``address`` and ``moved`` give addresses inside arrays: functions that take them count no references
and compile faster than with slices.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from numba import njit, types
from numba.core.registry import CPUDispatcher
from numba.extending import intrinsic, is_jitted

from mrgs.kernels.cache import keep_on_disk


class InnerFunction(CPUDispatcher):
    """A compiled function that has no entry for Python; without this class, a call would crash."""

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Raise TypeError."""
        raise TypeError(f"{self.py_func.__qualname__} can only be called by a kernel")


def _compiled(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """``njit`` with kernels on disk; without a function, the decorator."""
    if function is None:
        return partial(_compiled, **options)
    dispatcher = njit(error_model="numpy", no_cfunc_wrapper=True, **options)(function)
    if is_jitted(dispatcher):  # not so with NUMBA_DISABLE_JIT
        if options.get("no_cpython_wrapper", False):
            dispatcher.__class__ = InnerFunction
        else:
            keep_on_disk(dispatcher)
    return dispatcher


_inner = partial(_compiled, no_cpython_wrapper=True)

strict_kernel = _compiled
strict_parallel_kernel = partial(_compiled, parallel=True)
strict_inner_function = _inner
strict_inlined_function = partial(_inner, forceinline=True)

parallel_kernel = partial(_compiled, fastmath={"contract"}, parallel=True)
inner_function = partial(_inner, fastmath={"contract"})

reordering_kernel = partial(_compiled, fastmath={"contract", "reassoc"})
reordering_parallel_kernel = partial(reordering_kernel, parallel=True)
reordering_inner_function = partial(_inner, fastmath={"contract", "reassoc"})
reordering_inlined_function = partial(reordering_inner_function, forceinline=True)


@intrinsic
def address(typingctx: Any, array: Any, index: Any) -> Any:
    """Address of the element ``index`` of a contiguous array, counted through all dimensions; read
    and written like an array, unchecked. It does not keep the array alive: take addresses of a
    function's arguments only, which its caller keeps."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.gep(data, [context.cast(builder, args[1], sig.args[1], types.int64)])

    return types.CPointer(array.dtype)(array, index), codegen


@intrinsic
def moved(typingctx: Any, pointer: Any, count: Any) -> Any:
    """The address ``count`` elements further on."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.gep(args[0], [context.cast(builder, args[1], sig.args[1], types.int64)])

    return pointer(pointer, count), codegen
