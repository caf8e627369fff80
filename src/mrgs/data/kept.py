"""Whether something is still the same: stamps and digests of files, fingerprints of values, and
results that are kept until something that they depend on changes.

A result is one safetensors file with the fingerprint of everything that it depends on. Reading one
runs no code; a file that does not match is ignored.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar, get_args, get_origin

import msgspec
from jaxtyping import AbstractArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from mrgs.data.files import visible_files
from mrgs.errors import MrgsError
from mrgs.scene import Modality, modality_named
from mrgs.system.atomic import replacing, write_text
from mrgs.system.disk import open_regular, read_text

Result = TypeVar("Result")

FORMAT = 3
"""Raise it when results change their meaning: stored ones are then ignored."""

Stamp = tuple[int, int, int]
"""Size in bytes, mtime and ctime (ns). An export may give a file its old size and mtime; the
ctime is the system's own."""

MISSING = object()
"""Returned for a result that is not stored; a stored result may be None."""


class Cache:
    """Results by name; each is computed once, until something that it depends on changes. ``made``
    is the number of results that were computed rather than found, so far."""

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
        """The stored result, or a new one; recomputed if one of its other ``files`` is missing.
        RunError if it cannot be written. ``kind`` is its type, or that type or None."""
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
    """Write a result; ``made_from`` is the fingerprint of everything that it depends on. RunError
    if the file cannot be written."""
    tensors: list[Tensor] = []
    metadata = {"value": json.dumps(_encode(value, tensors)), "made_from": made_from}
    named = {
        str(index): tensor.detach().clone().contiguous() for index, tensor in enumerate(tensors)
    }
    with replacing(path) as temporary:
        save_file(named, temporary, metadata)


def load(path: Path, kind: Any, made_from: str) -> Any:
    """The result that ``save`` wrote with this fingerprint; ``MISSING`` if there is none. ``kind``
    is the type of the result, or that type or None."""
    try:
        if not path.is_file():  # a pipe would wait for ever
            return MISSING
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
        OSError, SafetensorError, LookupError, TypeError, ValueError, RecursionError, MrgsError
    ):  # fmt: skip
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
    """The stamp of a file, or of a link itself if that is not followed. OSError if there is no such
    file, or its folder cannot be read."""
    status = path.stat(follow_symlinks=follow)
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


def stamps(folder: Path) -> tuple[tuple[str, int, int, int], ...]:
    """Path and ``Stamp`` of every file below a folder, sorted; links to files are followed, hidden
    ones skipped. SceneError if the folder cannot be listed."""
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
        with open_regular(path) as file:
            while block := file.read(2**20):
                found.update(block)
        return found.hexdigest()
    except OSError:
        return ""


_Digest: TypeAlias = tuple[int, int, int, str]
"""The stamp of a file, and the SHA-256 of its content."""


class Digests:
    """Digests of files, remembered in a JSON ``file`` between calls, if it is readable: a file is
    read again only if its stamp has changed."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._saved: dict[str, _Digest] = {}
        with suppress(OSError, msgspec.MsgspecError, RecursionError):
            self._saved = msgspec.json.decode(read_text(file), type=dict[str, _Digest])
        self._known = dict(self._saved)
        self._asked: set[str] = set()

    def of(self, path: Path) -> str:
        """SHA-256 of a file's content; empty if it cannot be read, which is not remembered."""
        name = str(path)
        try:
            stamp = stamp_of(path)
        except OSError:
            return ""
        known = self._known.get(name)
        if known is None or known[:3] != stamp:
            known = *stamp, digest(path)
        if known[3]:
            self._known[name] = known
            self._asked.add(name)
        return known[3]

    def save(self, forget_others: bool = False) -> None:
        """Remember the digests. RunError if the file cannot be written. ``forget_others`` after a
        pass over all files: those not asked for are gone."""
        if forget_others:
            self._known = {name: self._known[name] for name in self._known if name in self._asked}
        if self._known != self._saved:
            self._saved = dict(self._known)
            write_text(self._file, json.dumps(self._known))
