"""torch as the method needs it, whatever the caller has set."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def own_modes() -> Iterator[None]:
    """Within this block gradients are recorded, ``torch.inference_mode`` is off, and float32 is the
    default type.

    The first two are the thread's; the default type is the process's, and so it is changed only
    where the caller has chosen another one.
    """
    with torch.inference_mode(False), torch.enable_grad(), _float32():
        yield


@contextmanager
def _float32() -> Iterator[None]:
    chosen = torch.get_default_dtype()
    if chosen == torch.float32:
        yield
        return
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(chosen)
