"""How the Numba kernels are compiled: on first call and kept on disk; division by zero gives inf.

Three arithmetics, each with a parallel variant:

- ``strict``: as IEEE 754 has it, operation by operation.
- without a prefix: a multiplication and an addition may become one operation (contract).
- ``reordering``: the compiler may also reorder sums, so that it can use vectors (reassoc). The
  order is fixed in the compiled code, and so are the bits. NaN and infinity are kept.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from numba import njit
from numba.extending import is_jitted

from mrgs.kernels.cache import keep_on_disk


def _compiled(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """``njit`` with kernels on disk; without a function, the decorator."""
    if function is None:
        return partial(_compiled, **options)
    dispatcher = njit(error_model="numpy", **options)(function)
    if is_jitted(dispatcher):  # not so with NUMBA_DISABLE_JIT
        keep_on_disk(dispatcher)
    return dispatcher


strict_kernel = _compiled
strict_parallel_kernel = partial(_compiled, parallel=True)
strict_inlined_kernel = partial(_compiled, forceinline=True)

kernel = partial(_compiled, fastmath={"contract"})
parallel_kernel = partial(kernel, parallel=True)

reordering_kernel = partial(_compiled, fastmath={"contract", "reassoc"})
reordering_parallel_kernel = partial(reordering_kernel, parallel=True)
