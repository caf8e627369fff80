"""Checkpoints with other contents than a training wrote."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from mrgs.run_files.checkpoint import write_file


def header_of(path: Path) -> dict[str, Any]:
    """The header of a checkpoint, unchecked."""
    with safe_open(path, framework="pt") as file:
        header: dict[str, Any] = json.loads(file.metadata()["mrgs"])
    return header


def rewrite(path: Path, tensors: Mapping[str, Tensor] | None = None, **changes: Any) -> None:
    """Write a checkpoint anew, whole and with the right digests.

    Args:
        path: the checkpoint.
        tensors: instead of its own.
        changes: entries of the header; "removed" takes one away.
    """
    header = {**header_of(path), **changes}
    header = {name: value for name, value in header.items() if value != "removed"}
    write_file(path, load_file(path) if tensors is None else tensors, header)


def rewrite_without_digests(
    path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any] | None = None
) -> None:
    """Write a checkpoint in the last format without digests, with tensors of any values.

    Args:
        path: the checkpoint.
        tensors: by name.
        header: its own if None.
    """
    header = {**(header_of(path) if header is None else header), "format": 5}
    contiguous = {name: tensor.contiguous() for name, tensor in tensors.items()}
    save_file(contiguous, path, {"mrgs": json.dumps(header)})
