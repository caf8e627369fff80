"""How the Numba kernels are compiled: on first call and kept on disk; division by zero gives inf.

Three arithmetics, each with a parallel variant:

- ``strict``: as IEEE 754 has it, operation by operation.
- without a prefix: a multiplication and an addition may become one operation (contract).
- ``reordering``: the compiler may also reorder sums, so that it can use vectors (reassoc). The
  order is fixed in the compiled code, and so are the bits. NaN and infinity are kept.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path

from numba import njit

_PACKAGE = Path(__file__).parents[1]

COMPILED_IN = (
    "baselines/thermonerf/hash_grid.py",
    "field/spherical_harmonics.py",
    "rasterizer/contract.py",
    "rasterizer/splat.py",
)
"""Files outside of ``kernels`` whose constants are compiled into kernels."""


def drop_stale_kernels(folder: Path, others: Iterable[Path] = ()) -> None:
    """Delete the compiled kernels below a folder if any source below it, or any other file that
    they were compiled from, has changed.

    Numba looks at a kernel's own file only, but kernels take constants and functions from each
    other's files.
    """
    sources = [*sorted(folder.rglob("*.py")), *others]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
    stamp = folder / "__pycache__" / "kernels.sha256"
    with suppress(OSError):  # a folder that cannot be written to holds no kernels either
        if not stamp.exists() or stamp.read_text() != digest:
            for pattern in ("*.nbi", "*.nbc"):
                for path in folder.rglob(f"__pycache__/{pattern}"):
                    path.unlink(missing_ok=True)
            stamp.parent.mkdir(exist_ok=True)
            stamp.write_text(digest)


drop_stale_kernels(Path(__file__).parent, [_PACKAGE / name for name in COMPILED_IN])

_compiled = partial(njit, cache=True, error_model="numpy")

strict_kernel = _compiled
strict_parallel_kernel = partial(_compiled, parallel=True)
strict_inlined_kernel = partial(_compiled, forceinline=True)

kernel = partial(_compiled, fastmath={"contract"})
parallel_kernel = partial(kernel, parallel=True)

reordering_kernel = partial(_compiled, fastmath={"contract", "reassoc"})
reordering_parallel_kernel = partial(reordering_kernel, parallel=True)
