"""How the functions that the kernels share are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import triton


def device_function(function: Callable) -> Any:
    """``triton.jit`` for what only kernels call; left as it is where Triton interprets.

    The interpreter takes milliseconds to enter each function that it knows of, and runs what it
    does not know alike.
    """
    jitted = triton.jit(function)
    return jitted if isinstance(jitted, triton.JITFunction) else function
