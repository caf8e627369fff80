"""Results of stages and of single photos, kept between calls.

``Cache`` alone decides what is recomputed. A result is one safetensors file with the
fingerprint of everything that it depends on. Reading one runs no code; a file that does not match
is ignored.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

from filelock import FileLock, Timeout
from jaxtyping import AbstractArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from mrgs.data.files import visible_files
from mrgs.errors import MrgsError, RunError
from mrgs.scene import Modality, modality_named
from mrgs.system.atomic import replacing, write_error

Result = TypeVar("Result")

CACHE_FOLDER = "prepare"
"""The cache's folder, inside the scene's folder."""

LOCK = ".lock"
"""File in it, by which a process holds the folder."""

FORMAT = 3
"""Raise it when results change their meaning: stored ones are then ignored."""

_BLOCK_BYTES = 2**20

Stamp = tuple[int, int, int]
"""Size in bytes, mtime and ctime (ns). An export may give a file its old size and mtime; the
ctime is the system's own. On Windows it is the time of creation, which an overwrite keeps."""

MISSING = object()
"""Returned for a result that is not stored; a stored result may be None."""


class Cache:
    """Results by name; each is computed once, until something that it depends on changes.

    Attributes:
        folder: keeps the results.
        made: number of results that were computed rather than found, so far.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.made = 0

    def get(
        self,
        name: str,
        kind: Any,
        depends: Iterable[Any],
        make: Callable[[], Result],
        files: Callable[[Result], Iterable[Path]] = lambda result: (),
    ) -> Result:
        """The stored result, or a new one.

        Args:
            name: of the result, and of its file.
            kind: type of the result, or that type or None.
            depends: values that the result depends on.
            make: computes the result.
            files: other files of the result; it is recomputed if one is missing.

        Raises:
            RunError: the result cannot be written (permissions, a full disk).
        """
        file = self._file(name)
        made_from = fingerprint(FORMAT, name, *depends)
        stored = load(file, kind, made_from)
        if stored is not MISSING and all(path.is_file() for path in files(stored)):
            return stored
        self.made += 1
        result = make()
        save(file, result, made_from)
        return result

    def forget(self, name: str) -> None:
        """Remove a result, so that it is recomputed."""
        self._file(name).unlink(missing_ok=True)

    def _file(self, name: str) -> Path:
        return self.folder / f"{name.replace(' ', '_')}.safetensors"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder against other processes; it is created if it is missing.

    Raises:
        RunError: the folder cannot be made, or another process works in it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / LOCK, timeout=0)
        lock.acquire()
    except Timeout:
        raise RunError(
            f"{folder.parent} is being prepared by another run: wait for it, or choose another "
            f"folder"
        ) from None
    except OSError as error:
        raise write_error(folder, error) from None
    with lock:
        yield


def fingerprint(*values: Any) -> str:
    """SHA-256 of values that can be stored; equal for equal values, on every machine."""
    digest = hashlib.sha256()
    tensors: list[Tensor] = []
    digest.update(json.dumps([_encode(value, tensors) for value in values]).encode())
    for tensor in tensors:
        digest.update(f"{tuple(tensor.shape)} {tensor.dtype}".encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


def save(path: Path, value: Any, made_from: str) -> None:
    """Write a result; ``made_from`` is the fingerprint of everything that it depends on.

    Raises:
        RunError: the file cannot be written (permissions, a full disk).
    """
    tensors: list[Tensor] = []
    metadata = {"value": json.dumps(_encode(value, tensors)), "made_from": made_from}
    named = {
        str(index): tensor.detach().clone().contiguous() for index, tensor in enumerate(tensors)
    }
    with replacing(path) as temporary:
        save_file(named, temporary, metadata)


def load(path: Path, kind: Any, made_from: str) -> Any:
    """The result that ``save`` wrote with this fingerprint; ``MISSING`` if there is none.

    Args:
        path: of the file.
        kind: type of the result, or that type or None.
        made_from: the fingerprint.
    """
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata()
            if metadata["made_from"] != made_from:
                return MISSING
            # Copies: what is mapped ends the process if the file is cut off, and on Windows keeps
            # the file from being replaced.
            names = file.keys()
            tensors = {name: file.get_tensor(name).clone() for name in names}
        return _decode(kind, json.loads(metadata["value"]), tensors)
    except (
        OSError,
        SafetensorError,
        LookupError,
        TypeError,
        ValueError,
        RecursionError,
        MrgsError,
    ):
        return MISSING


def _encode(value: Any, tensors: list[Tensor]) -> Any:
    """A value as JSON; tensors are appended to the list, and their index is their value."""
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, Tensor):
        tensors.append(value)
        return len(tensors) - 1
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, Modality):
        return value.name
    if dataclasses.is_dataclass(value):
        return {
            field.name: _encode(getattr(value, field.name), tensors)
            for field in dataclasses.fields(value)
        }
    if isinstance(value, Mapping):
        return {str(key): _encode(item, tensors) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_encode(item, tensors) for item in value]
    raise TypeError(f"{type(value).__name__} cannot be stored")


def _decode(hint: Any, value: Any, tensors: Mapping[str, Tensor]) -> Any:
    """The value of a type from the JSON of ``_encode``."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (types.UnionType, typing.Union):
        (hint,) = (option for option in arguments if option is not type(None))
        return None if value is None else _decode(hint, value, tensors)
    if origin is tuple:
        hints = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else arguments
        return tuple(_decode(own, item, tensors) for own, item in zip(hints, value, strict=True))
    if origin is not None and origin is not Literal and issubclass(origin, Mapping):
        return {
            _decode(arguments[0], key, tensors): _decode(arguments[1], item, tensors)
            for key, item in value.items()
        }
    if hint is Modality:
        return modality_named(value)
    if dataclasses.is_dataclass(hint):
        hints_of = typing.get_type_hints(hint)
        return hint(
            **{name: _decode(hints_of[name], item, tensors) for name, item in value.items()}
        )  # type: ignore[operator]
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return tensors[str(value)]
    if hint is Path:
        return Path(value)
    if isinstance(hint, type) and issubclass(hint, tuple):  # a NamedTuple
        return hint(*value)
    if hint is datetime:
        return datetime.fromisoformat(value)
    return value


def stamp_of(path: Path, *, follow: bool = True) -> Stamp:
    """The stamp of a file; of a link itself where it is not followed.

    Raises:
        OSError: there is none, or it cannot be looked at.
    """
    status = path.stat(follow_symlinks=follow)
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


def stamps(folder: Path) -> tuple[tuple[str, int, int, int], ...]:
    """Path and ``Stamp`` of every file below a folder, sorted.

    Links to files are followed. Hidden files and folders are skipped.

    Raises:
        SceneError: the folder cannot be listed.
    """
    return tuple(
        sorted(
            (path.relative_to(folder).as_posix(), *stamp_of(path, follow=path.exists()))
            for path in visible_files(folder)
        )
    )


def digest(path: Path) -> str:
    """SHA-256 of a file's content; empty if it cannot be read: the next reader raises the error."""
    try:
        found = hashlib.sha256()
        with open(path, "rb") as file:
            while block := file.read(_BLOCK_BYTES):
                found.update(block)
        return found.hexdigest()
    except OSError:
        return ""
