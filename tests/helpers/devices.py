"""What makes the host wait for a GPU."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def sync_debug_mode(mode: str) -> Iterator[None]:
    """torch tells of what makes the host wait for the GPU: "warn" or "error". Its notice that it
    may miss some is not an error."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings(
                "ignore", "Synchronization debug mode is a prototype feature", UserWarning
            )
            torch.cuda.set_sync_debug_mode(mode)
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")
