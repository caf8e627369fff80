"""Files that are either whole or not there."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout
from safetensors import SafetensorError

from mrgs.errors import RunError, WriteError

TEMPORARY = ".mrgs-"
"""How the names of temporary folders begin; a file is written in one and then moved."""

LOCK = ".lock"
"""File in a folder that a process keeps locked while it uses the folder."""

_LONGEST_SUFFIX = 16
LOCK_PATIENCE_S = 10.0

_swept: set[Path] = set()
"""Folders whose abandoned files this process has removed."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside ``path``, with the same suffix, which tells image writers the
    format. On success it is flushed to the disk and becomes ``path``; on an error it is removed, or
    by a later process if this one is killed. The folder is made if need be. WriteError if the file
    cannot be written (permissions, a full disk)."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.parent not in _swept:
            _swept.add(path.parent)
            _remove_abandoned(path.parent.iterdir())
        with _temporary_beside(path) as temporary:
            yield temporary
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
    except (OSError, SafetensorError) as error:
        raise write_error(path, error) from error


def write_text(path: Path, text: str) -> Path:
    """Write a text file in UTF-8, whole or not at all; returns the path. What is not UTF-8 becomes
    an escape such as ``\\udcff``, which JSON reads back. WriteError if that fails."""
    return write_texts(path, [text])


def write_texts(path: Path, texts: Iterable[str]) -> Path:
    """Write texts one behind the other into one file; see ``write_text``."""
    with (
        replacing(path) as temporary,
        open(temporary, "w", encoding="utf-8", errors="backslashreplace") as file,
    ):
        file.writelines(texts)
    return path


def require_folder(folder: Path) -> None:
    """Check that a folder is still there, before something is written that belongs to what it held:
    on a drive that was pulled out, ``replacing`` would make an empty one in its place. WriteError
    if it is gone."""
    try:
        there = folder.is_dir()
    except OSError:  # a drive that does not answer
        there = False
    if not there:
        raise WriteError(
            f"the folder {folder} is gone: nothing can be saved until it is back; reconnect its "
            f"drive, or move it back"
        )


@contextmanager
def locked(
    file: Path, in_use: RunError, wait_s: float = 0, options: tuple[str, ...] = ()
) -> Iterator[None]:
    """Within this block no other process holds a lock file, whose folder is made; the system
    releases it when the process ends, however it ends. ``in_use`` if another one still holds it
    after ``wait_s``, which is forever if negative; WriteError if the folder cannot be written."""
    lock = FileLock(file)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=wait_s)
    except Timeout:
        raise in_use from None
    except OSError as error:
        raise write_error(file.parent, error, options) from error
    try:
        yield
    finally:
        lock.release()


def changing(kept: Path) -> AbstractContextManager[None]:
    """Around a change of a file, one at a time whatever process makes it, by ``.NAME.lock`` beside
    it. RunError if another one takes too long; WriteError if the folder is gone or read-only."""
    require_folder(kept.parent)  # the lock would make the folder again
    in_use = RunError(f"another process keeps {kept} locked: end it, then try again")
    return locked(kept.with_name(f".{kept.stem}.lock"), in_use, LOCK_PATIENCE_S)


def remove(path: Path) -> None:
    """Remove a file if it is there. WriteError if it cannot be removed."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise WriteError(
            f"{path} cannot be removed ({error.strerror}): remove it, or choose another folder"
        ) from None


def remove_abandoned(folder: Path) -> None:
    """Remove the temporary files of dead processes in a folder and all below it."""
    _remove_abandoned(folder.rglob(f"{TEMPORARY}*"))


def write_error(path: Path, error: Exception, options: tuple[str, ...] = ()) -> WriteError:
    """The error of a file or a folder that cannot be written, with its remedy, from an error of the
    system or of the safetensors library."""
    number, reason = getattr(error, "errno", None), getattr(error, "strerror", None) or str(error)
    if isinstance(error, SafetensorError) and (found := re.search(r"os error (\d+)", reason)):
        number = int(found[1])
        reason = os.strerror(number)
    if number == errno.ENAMETOOLONG:
        remedy = "choose a shorter name"
    elif number in (errno.EACCES, errno.EPERM, errno.EROFS):
        remedy = "choose a place that you may write to"
    else:
        remedy = "make room, or choose another place"
    return WriteError(f"{path} cannot be written ({reason}): {remedy}", options=options)


@contextmanager
def _temporary_beside(path: Path) -> Iterator[Path]:
    """A path in a folder of its own, which goes with all that a writer leaves there, and is locked
    as long as this process lives: others can tell if it is abandoned."""
    folder = Path(tempfile.mkdtemp(prefix=TEMPORARY, dir=path.parent))
    lock = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield folder / f"file{path.suffix if len(path.suffix) <= _LONGEST_SUFFIX else ''}"
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _remove_abandoned(paths: Iterator[Path]) -> None:
    """Remove those of the paths that are temporary folders which no process has locked."""
    with suppress(OSError):  # a folder that may not be listed
        for path in [path for path in paths if path.name.startswith(TEMPORARY)]:
            with suppress(OSError):  # gone, a link, another user's, locked, or without locks
                lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(path, ignore_errors=True)
                finally:
                    os.close(lock)
