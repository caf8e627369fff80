"""Lists whose length only the GPU knows, while it records a step.

A CUDA graph replays work of fixed sizes. What makes a list asks here how long it may be: outside of
a recording the host waits for the length; within one the list has room to spare, and its length
stays on the GPU, where the one who replays can read whether the room sufficed.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from jaxtyping import Int64
from torch import Tensor


class ListRoom:
    """The room of the lists that are made within ``lists_have``.

    Args:
        size: entries of each list; None to measure how many are needed.

    Attributes:
        size: as given.
        measured: entries of the longest list, where the size is None.
    """

    def __init__(self, size: int | None = None) -> None:
        self.size = size
        self.measured = 0
        self._lengths: list[Int64[Tensor, "1"]] = []

    def for_list(self, length: Int64[Tensor, "1"]) -> int:
        """Entries of a list that has this length; what lies beyond them is left out."""
        if self.size is None:
            self.measured = max(self.measured, int(length))
            return int(length)
        self._lengths.append(length)
        return self.size

    def needed(self) -> Int64[Tensor, ""]:
        """Length of the longest list, on the device; there must be one."""
        return torch.cat(self._lengths).max()


_room: ContextVar[ListRoom | None] = ContextVar("mrgs_list_room", default=None)


@contextmanager
def lists_have(room: ListRoom) -> Iterator[None]:
    """Within this block, lists on a GPU have this room."""
    token = _room.set(room)
    try:
        yield
    finally:
        _room.reset(token)


def room_of_list(length: Int64[Tensor, "1"]) -> int:
    """Entries to make room for in a list of this length; the host waits for it, unless a step is
    recorded."""
    room = _room.get()
    return int(length) if room is None else room.for_list(length)
