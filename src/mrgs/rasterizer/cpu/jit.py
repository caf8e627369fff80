"""How every kernel of this room is compiled: on first call, kept on disk, division by zero gives inf."""

from __future__ import annotations

from functools import partial

from numba import njit

kernel = partial(njit, cache=True, error_model="numpy")
parallel_kernel = partial(njit, cache=True, error_model="numpy", parallel=True)
inlined_kernel = partial(njit, cache=True, error_model="numpy", forceinline=True)
