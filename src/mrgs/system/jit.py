"""The compiled kernels that Numba keeps on disk."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path


def drop_stale_kernels(room: Path, *others: Path) -> None:
    """Delete the compiled kernels of a folder if any of its sources, or one of the other files, has
    changed.

    Numba looks at a kernel's own file only, but kernels take constants and functions from each
    other's files.
    """
    sources = [*sorted(room.glob("*.py")), *others, Path(__file__)]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
    stamp = room / "__pycache__" / "kernels.sha256"
    with suppress(OSError):  # a folder that cannot be written to holds no kernels either
        if not stamp.exists() or stamp.read_text() != digest:
            for pattern in ("*.nbi", "*.nbc"):
                for path in stamp.parent.glob(pattern):
                    path.unlink(missing_ok=True)
            stamp.parent.mkdir(exist_ok=True)
            stamp.write_text(digest)
