"""How every kernel of this room is compiled: on first call, kept on disk, multiply-adds fused."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from numba import njit

import mrgs.field.cpu
from mrgs.system.jit import drop_stale_kernels

drop_stale_kernels(
    Path(__file__).parent, *sorted(Path(mrgs.field.cpu.__file__).parent.glob("*.py"))
)

kernel = partial(njit, cache=True, error_model="numpy", fastmath={"contract"})
parallel_kernel = partial(
    njit, cache=True, error_model="numpy", fastmath={"contract"}, parallel=True
)
