"""Work on a GPU that is recorded once and then started as one, and its lists, whose length only the
GPU knows. A CUDA graph replays work of fixed sizes: within a recording a list has room to spare
(``room_of_list``), and its length stays on the GPU, where the replaying side can read whether it
sufficed; outside, the host waits for the length."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from threading import RLock
from typing import Any, Literal

import torch
from jaxtyping import Int64
from torch import Tensor


class CudaGraph:
    """A CUDA graph, and a number that it leaves for the host. RuntimeError if the work waits for
    the GPU, or its memory does not suffice. ``work`` is what is recorded: it queues the same work
    for tensors at the same places whenever it is called, does not wait for the GPU, and returns the
    number. ``cuda`` is torch's module, or a stand-in."""

    def __init__(
        self, work: Callable[[], Int64[Tensor, ""]], device: torch.device, cuda: Any = torch.cuda
    ) -> None:
        self._graph = cuda.CUDAGraph()
        self._arrived = cuda.Event()
        self._fetched = torch.zeros((), dtype=torch.int64, pin_memory=device.type == "cuda")
        stream, current = cuda.Stream(device), cuda.current_stream(device)
        stream.wait_stream(current)
        # While torch records, it gives back nothing of what it keeps in reserve.
        cuda.empty_cache()
        # cuBLAS has a workspace per stream, which is made in the memory of the graph that first
        # needs it: torch must neither keep it when the graph is gone, nor use it in another graph.
        torch._C._cuda_clearCublasWorkspaces()
        with cuda.stream(stream):
            # Other threads may use the GPU meanwhile: a viewer does.
            self._graph.capture_begin(capture_error_mode="thread_local")
            try:
                self._number = work()
            except BaseException:
                with suppress(RuntimeError):  # says only that there was an error before
                    self._graph.capture_end()
                raise
            else:
                self._graph.capture_end()
            finally:
                torch._C._cuda_clearCublasWorkspaces()
        current.wait_stream(stream)

    def replay(self) -> None:
        """Queue the recorded work; the number is on its way to the host behind it."""
        self._graph.replay()
        self._fetched.copy_(self._number, non_blocking=True)
        self._arrived.record()

    def number(self) -> int:
        """What the last replay left; the host waits for it, not for what was queued since."""
        self._arrived.synchronize()
        return int(self._fetched)


_sync_debug = RLock()


@contextmanager
def sync_debug_mode(mode: Literal["warn", "error"], cuda: Any = torch.cuda) -> Iterator[None]:
    """Within this block, torch reports operations that make the host wait for the GPU, by a warning
    or a RuntimeError. The mode applies to all threads; their blocks wait for each other."""
    with _sync_debug:
        before = cuda.get_sync_debug_mode()
        try:
            _set_sync_debug_mode(mode, cuda)
            yield
        finally:
            _set_sync_debug_mode(before, cuda)


def _set_sync_debug_mode(mode: int | str, cuda: Any) -> None:
    """torch's notice that it may miss some waits is left out: it is not a warning to the user, and
    where warnings are errors it would leave the mode on."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Synchronization debug mode is a prototype")
        cuda.set_sync_debug_mode(mode)


class ListRoom:
    """The room of the lists that are made within ``lists_have``: ``size`` entries each; without a
    size, those of the longest list are ``measured``."""

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
    """Entries to make room for in such a list; the host waits for it, unless it is recorded."""
    room = _room.get()
    return int(length) if room is None else room.for_list(length)
