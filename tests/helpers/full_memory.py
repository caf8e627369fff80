"""Memory that runs out wherever a test wants it to."""

from __future__ import annotations

from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode


class FullAt(TorchDispatchMode):
    """Within this block there is memory for so many new tensors and no more."""

    def __init__(self, tensors: int) -> None:
        super().__init__()
        self._left = tensors

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        returned = func._schema.returns
        if returned and all(each.alias_info is None for each in returned):  # no view, not in place
            if self._left == 0:
                raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
            self._left -= 1
        return func(*args, **(kwargs or {}))
