"""How every kernel of this room is compiled: on first call, kept on disk, division by zero gives
inf.

Multiply-adds may be fused and sums reordered by the compiler, so that it can use vectors; the order
is fixed in the compiled code, and so are the bits. NaN and infinity are kept.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from numba import njit

from mrgs.system.jit import drop_stale_kernels

_ROOM = Path(__file__).parent
drop_stale_kernels(_ROOM, _ROOM.parent / "spherical_harmonics.py")

_VECTORISED = {"contract", "reassoc"}
kernel = partial(njit, cache=True, error_model="numpy", fastmath=_VECTORISED)
parallel_kernel = partial(
    njit, cache=True, error_model="numpy", fastmath=_VECTORISED, parallel=True
)
