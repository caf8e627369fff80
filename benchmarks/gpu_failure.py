"""What a measurement or a comparison of the GPU benchmark leaves instead of a result."""

from __future__ import annotations

import traceback
from typing import Any

from mrgs.system.gpu import lacks_memory


def failure(error: Exception) -> dict[str, Any]:
    """``skipped``, where the device's memory does not suffice; otherwise ``failed`` and the
    traceback.

    Messages of CUDA begin with what is wrong, those of Triton's compiler end with it: both lines
    are kept.
    """
    if lacks_memory(error):
        return {"skipped": "out of memory"}
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    message = " … ".join(dict.fromkeys([*lines[:1], *lines[-1:]]))
    name = type(error).__name__
    return {
        "failed": f"{name}: {message}" if message else name,
        "traceback": "".join(traceback.format_exception(error)),
    }
