"""What surrounds a recording, with stand-ins for what needs a GPU."""

from __future__ import annotations

import warnings
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import torch

from mrgs.system.cuda_graph import CudaGraph, sync_debug_mode

DEVICE = torch.device("cuda", 0)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of torch's functions, in the order in which they are called."""
    called: list[str] = []

    class Graph:
        """Its end fails after work that failed, as CUDA's does."""

        def capture_begin(self, capture_error_mode: str) -> None:
            called.append("begin")

        def capture_end(self) -> None:
            called.append("end")
            if "failed" in called:
                raise RuntimeError("failed due to a previous error during capture")

        def replay(self) -> None:
            called.append("replay")

    stream = SimpleNamespace(wait_stream=lambda other: None)
    event = SimpleNamespace(record=lambda: None, synchronize=lambda: called.append("wait"))
    original = torch.zeros
    for name, function in {
        "CUDAGraph": Graph,
        "Event": lambda: event,
        "Stream": lambda device: stream,
        "current_stream": lambda device: stream,
        "stream": lambda which: nullcontext(),
        "empty_cache": lambda: called.append("empty"),
    }.items():
        monkeypatch.setattr(torch.cuda, name, function)
    monkeypatch.setattr(
        torch._C, "_cuda_clearCublasWorkspaces", lambda: called.append("clear"), raising=False
    )
    monkeypatch.setattr(torch, "zeros", lambda *size, pin_memory, **kind: original(*size, **kind))
    return called


def test_a_graph_owns_its_memory_and_leaves_a_number(calls: list[str]) -> None:
    number = torch.tensor(7)
    graph = CudaGraph(lambda: number, DEVICE)
    assert calls == ["empty", "clear", "begin", "end", "clear"]
    graph.replay()
    assert graph.number() == 7
    assert calls[5:] == ["replay", "wait"]


def test_work_that_fails_says_why(calls: list[str]) -> None:
    def fails() -> torch.Tensor:
        calls.append("failed")
        raise RuntimeError("operation not permitted when stream is capturing")

    with pytest.raises(RuntimeError, match="not permitted"):
        CudaGraph(fails, DEVICE)
    assert calls[-2:] == ["end", "clear"]


def test_waits_are_told_of_without_torchs_notice(monkeypatch: pytest.MonkeyPatch) -> None:
    modes: list[int | str] = []

    def set_mode(mode: int | str) -> None:
        modes.append(mode)
        warnings.warn("Synchronization debug mode is a prototype feature and ...", stacklevel=1)

    monkeypatch.setattr(torch.cuda, "get_sync_debug_mode", lambda: 0)
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", set_mode)
    with pytest.raises(RuntimeError, match="synchronizing"), sync_debug_mode("error"):
        raise RuntimeError("called a synchronizing CUDA operation")
    with pytest.warns(UserWarning, match="called a synchronizing"), sync_debug_mode("warn"):
        warnings.warn("called a synchronizing CUDA operation", stacklevel=1)
    assert modes == ["error", 0, "warn", 0]
