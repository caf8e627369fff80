"""Results of stages as files: plain dataclasses with paths, times and tensors in one safetensors
file each.

Reading one runs no code, and a file that does not fit is as good as none: its stage is done again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from jaxtyping import AbstractArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from mrgs.errors import MrgsError
from mrgs.system.atomic import replacing


@dataclass(frozen=True)
class Stored:
    """A result that was found in a file; it may be None."""

    value: Any


def fingerprint(*values: Any) -> str:
    """A digest of values that ``save`` could write: equal for equal values, on every machine."""
    digest = hashlib.sha256()
    tensors: list[Tensor] = []
    digest.update(json.dumps([_encode(value, tensors) for value in values]).encode())
    for tensor in tensors:
        digest.update(f"{tuple(tensor.shape)} {tensor.dtype}".encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


def save(path: Path, value: Any, made_from: str) -> None:
    """Write a result; ``made_from`` is the fingerprint of everything that it follows from.

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


def load(path: Path, kind: Any, made_from: str) -> Stored | None:
    """The result that ``save`` wrote, of a type or of a type or None; None if there is none that
    follows from that."""
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata()
            if metadata["made_from"] != made_from:
                return None
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return Stored(_decode(kind, json.loads(metadata["value"]), tensors))
    except (
        OSError,
        SafetensorError,
        LookupError,
        TypeError,
        ValueError,
        RecursionError,
        MrgsError,
    ):
        return None


def _encode(value: Any, tensors: list[Tensor]) -> Any:
    """A value as JSON; tensors are put aside, and their place in the list stands for them."""
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, Tensor):
        tensors.append(value)
        return len(tensors) - 1
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, datetime):
        return value.isoformat()
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
    """The value of a type that ``_encode`` made JSON of."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (types.UnionType, typing.Union):
        (hint,) = (option for option in arguments if option is not type(None))
        return None if value is None else _decode(hint, value, tensors)
    if origin is tuple:
        hints = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else arguments
        return tuple(_decode(own, item, tensors) for own, item in zip(hints, value, strict=True))
    if origin is not None and origin is not Literal and issubclass(origin, Mapping):
        return {key: _decode(arguments[1], item, tensors) for key, item in value.items()}
    if dataclasses.is_dataclass(hint):
        hints_of = typing.get_type_hints(hint)
        return hint(
            **{name: _decode(hints_of[name], item, tensors) for name, item in value.items()}
        )  # type: ignore[operator]
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return tensors[str(value)]
    if hint is Path:
        return Path(value)
    if hint is datetime:
        return datetime.fromisoformat(value)
    return value
