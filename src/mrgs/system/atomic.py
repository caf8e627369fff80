"""Files that are either whole or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mrgs.errors import RunError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside ``path``; on success it is brought to the disk and becomes
    ``path``.

    On any error the temporary file is removed. The folder is made if need be, and the suffix is
    kept, because image writers choose the format by it.

    Raises:
        RunError: the file cannot be written (permissions, a full disk).
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise RunError(
            f"{path} cannot be written ({error.strerror or error}): free the place or choose "
            f"another"
        ) from error
    finally:
        with suppress(OSError):  # it became the file, or was never made
            temporary.unlink()


def remove(path: Path) -> None:
    """Remove a file if it is there.

    Raises:
        RunError: it cannot be removed.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise RunError(
            f"{path} cannot be removed ({error.strerror}): remove it, or choose another folder"
        ) from None
