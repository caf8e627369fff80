"""Small tensors need one thread."""

from __future__ import annotations

from tests.helpers.threads import one_torch_thread

__all__ = ["one_torch_thread"]
