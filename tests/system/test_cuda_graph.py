"""What surrounds a recording, with stand-ins for what needs a GPU."""

from __future__ import annotations

import warnings
from contextlib import AbstractContextManager, nullcontext
from types import SimpleNamespace

import pytest
import torch

from mrgs.system.cuda_graph import CudaGraph, sync_debug_mode
from mrgs.system.gpu import HOST


class Cuda:
    """In place of torch.cuda; ``calls`` holds the names of what is called, in order."""

    def __init__(self, calls: list[str]) -> None:
        self.calls = calls
        event = SimpleNamespace(record=lambda: None, synchronize=lambda: calls.append("wait"))
        stream = SimpleNamespace(wait_stream=lambda other: None)
        self.CUDAGraph = lambda: Graph(calls)
        self.Event = lambda: event
        self.Stream = self.current_stream = lambda device: stream

    def stream(self, which: SimpleNamespace) -> AbstractContextManager[None]:
        return nullcontext()

    def empty_cache(self) -> None:
        self.calls.append("empty")

    def get_sync_debug_mode(self) -> int:
        return 0

    def set_sync_debug_mode(self, mode: int | str) -> None:
        self.calls.append(str(mode))
        warnings.warn("Synchronization debug mode is a prototype feature and ...", stacklevel=1)


class Graph:
    """Its end fails after work that failed, as CUDA's does."""

    def __init__(self, calls: list[str]) -> None:
        self.calls = calls

    def capture_begin(self, capture_error_mode: str) -> None:
        self.calls.append("begin")

    def capture_end(self) -> None:
        self.calls.append("end")
        if "failed" in self.calls:
            raise RuntimeError("failed due to a previous error during capture")

    def replay(self) -> None:
        self.calls.append("replay")


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of what is called, in order."""
    called: list[str] = []
    monkeypatch.setattr(
        torch._C, "_cuda_clearCublasWorkspaces", lambda: called.append("clear"), raising=False
    )
    return called


def test_a_graph_owns_its_memory_and_leaves_a_number(calls: list[str]) -> None:
    number = torch.tensor(7)
    graph = CudaGraph(lambda: number, HOST, Cuda(calls))
    assert calls == ["empty", "clear", "begin", "end", "clear"]
    graph.replay()
    assert graph.number() == 7
    assert calls[5:] == ["replay", "wait"]


def test_work_that_fails_says_why(calls: list[str]) -> None:
    def fails() -> torch.Tensor:
        calls.append("failed")
        raise RuntimeError("operation not permitted when stream is capturing")

    with pytest.raises(RuntimeError, match="not permitted"):
        CudaGraph(fails, HOST, Cuda(calls))
    assert calls[-2:] == ["end", "clear"]


def test_waits_are_told_of_without_torchs_notice() -> None:
    cuda = Cuda([])
    with pytest.raises(RuntimeError, match="synchronizing"), sync_debug_mode("error", cuda):
        raise RuntimeError("called a synchronizing CUDA operation")
    with pytest.warns(UserWarning, match="called a synchronizing"), sync_debug_mode("warn", cuda):
        warnings.warn("called a synchronizing CUDA operation", stacklevel=1)
    assert cuda.calls == ["error", "0", "warn", "0"]
