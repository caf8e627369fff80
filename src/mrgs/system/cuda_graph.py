"""Work on a GPU that is recorded once and then started as one."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Int64
from torch import Tensor


class CudaGraph:
    """A CUDA graph, and a number that it leaves for the host.

    Args:
        work: what is recorded: it queues the same work for tensors at the same places whenever it
            is called, does not wait for the GPU, and returns the number.
        device: a CUDA device.

    Raises:
        RuntimeError: the work waits for the GPU, or its memory does not suffice.
    """

    def __init__(self, work: Callable[[], Int64[Tensor, ""]], device: torch.device) -> None:
        self._graph = torch.cuda.CUDAGraph()
        self._arrived = torch.cuda.Event()
        self._fetched = torch.zeros((), dtype=torch.int64, pin_memory=True)
        stream, current = torch.cuda.Stream(device), torch.cuda.current_stream(device)
        stream.wait_stream(current)
        with torch.cuda.stream(stream):
            # Other threads may use the GPU meanwhile: a viewer does.
            self._graph.capture_begin(capture_error_mode="thread_local")
            try:
                self._number = work()
            finally:
                self._graph.capture_end()
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
