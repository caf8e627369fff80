"""How the kernels of this room are compiled: on first call, kept on disk, multiply-adds fused."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from numba import njit

from mrgs.system.jit import drop_stale_kernels

drop_stale_kernels(Path(__file__).parent)

kernel = partial(njit, cache=True, error_model="numpy", fastmath={"contract"})
parallel_kernel = partial(
    njit, cache=True, error_model="numpy", fastmath={"contract"}, parallel=True
)
summing_kernel = partial(njit, cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
"""The order of its sums is the compiler's, but always the same."""
