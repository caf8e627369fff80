"""How every kernel of this room is compiled: on first call, kept on disk, division by zero gives inf."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from functools import partial
from pathlib import Path

from numba import njit

_ROOM = Path(__file__).parent


def _drop_stale_kernels() -> None:
    """Delete the compiled kernels if any source of the room has changed.

    Numba looks at a kernel's own file only, but the kernels take constants and functions from each other's files.
    """
    sources = [*sorted(_ROOM.glob("*.py")), _ROOM.parent / "contract.py"]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
    stamp = _ROOM / "__pycache__" / "kernels.sha256"
    with suppress(OSError):  # a folder that cannot be written to holds no kernels either
        if not stamp.exists() or stamp.read_text() != digest:
            for pattern in ("*.nbi", "*.nbc"):
                for path in stamp.parent.glob(pattern):
                    path.unlink(missing_ok=True)
            stamp.parent.mkdir(exist_ok=True)
            stamp.write_text(digest)


_drop_stale_kernels()

kernel = partial(njit, cache=True, error_model="numpy")
parallel_kernel = partial(njit, cache=True, error_model="numpy", parallel=True)
inlined_kernel = partial(njit, cache=True, error_model="numpy", forceinline=True)
