"""Memory for what a pass keeps until its backward pass."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np


class Activations:
    """An array that is not cleared; its memory goes to a later one when this is dropped.

    Fresh memory costs: the system clears each page when it is first touched, which takes as long as
    filling it.

    Attributes:
        array: float32, of the given shape.
    """

    _LARGEST_SPARES = 2
    _spare: ClassVar[list[np.ndarray]] = []

    def __init__(self, *shape: int) -> None:
        size = math.prod(shape)
        fitting = [
            place for place, memory in enumerate(self._spare) if size <= memory.size <= 2 * size
        ]
        self._memory = self._spare.pop(fitting[0]) if fitting else np.empty(size, np.float32)
        self.array = self._memory[:size].reshape(shape)

    def __del__(self) -> None:
        self._spare.append(self._memory)
        self._spare.sort(key=lambda memory: memory.size)
        del self._spare[: -self._LARGEST_SPARES]
