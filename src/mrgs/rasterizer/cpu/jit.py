"""How every kernel of this room is compiled: on first call, kept on disk, division by zero gives
inf."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from numba import njit

from mrgs.system.jit import drop_stale_kernels

_ROOM = Path(__file__).parent
drop_stale_kernels(_ROOM, _ROOM.parent / "contract.py")

kernel = partial(njit, cache=True, error_model="numpy")
parallel_kernel = partial(njit, cache=True, error_model="numpy", parallel=True)
inlined_kernel = partial(njit, cache=True, error_model="numpy", forceinline=True)
