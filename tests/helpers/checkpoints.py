"""Checkpoints with other contents than a training wrote."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch

from safetensors import safe_open
from safetensors.torch import load_file
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


def rewrite_unchecked(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write a checkpoint anew, with the right digests, and with tensors of any values."""
    with patch("mrgs.run_files.checkpoint.first_not_finite", return_value=None):
        rewrite(path, tensors)
