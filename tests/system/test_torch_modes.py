"""torch's modes within a training and a rendering, whatever the caller has set."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from mrgs.system.torch_modes import own_modes


class Thread(torch.autograd.Function):
    """Tells in which thread its backward pass runs."""

    last = 0

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return x.clone()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        Thread.last = threading.get_ident()
        return grad


def backward_thread(device: str) -> int:
    x = torch.ones(3, device=device, requires_grad=True)
    Thread.apply(x).sum().backward()
    assert x.grad is not None
    assert x.grad.tolist() == [1.0] * 3
    return Thread.last


def test_the_callers_modes_are_back_afterwards():
    with torch.inference_mode():
        with own_modes():
            assert backward_thread("cpu") == threading.get_ident()
            assert not torch._C._is_multithreading_enabled()
        assert torch.is_inference_mode_enabled()
    assert torch._C._is_multithreading_enabled()


@pytest.mark.gpu
def test_a_gpus_backward_pass_runs_in_the_thread_that_asks_for_it():
    with own_modes():
        assert backward_thread("cuda") == threading.get_ident()


@pytest.fixture
def precisions() -> Iterator[Callable[[], tuple[bool, str]]]:
    """What torch is set to; as before afterwards."""

    def found() -> tuple[bool, str]:
        return torch.backends.cudnn.allow_tf32, torch.get_float32_matmul_precision()

    before = found()
    yield found
    torch.backends.cudnn.allow_tf32 = before[0]
    torch.set_float32_matmul_precision(before[1])


@pytest.mark.parametrize("chosen", [(True, "highest"), (True, "medium"), (False, "high")])
def test_products_are_not_rounded_and_the_callers_choice_is_back_afterwards(chosen, precisions):
    torch.backends.cudnn.allow_tf32 = chosen[0]
    torch.set_float32_matmul_precision(chosen[1])
    with own_modes():
        assert precisions() == (False, "highest")
        with own_modes():
            pass
        assert precisions() == (False, "highest")
    assert precisions() == chosen


def test_the_choice_is_back_when_the_last_thread_is_done(precisions):
    torch.set_float32_matmul_precision("high")
    entered, leave = threading.Event(), threading.Event()

    def other() -> None:
        with own_modes():
            entered.set()
            leave.wait(60)

    thread = threading.Thread(target=other)
    with own_modes():
        thread.start()
        assert entered.wait(60)
    assert precisions() == (False, "highest")
    leave.set()
    thread.join()
    assert precisions()[1] == "high"


def test_precisions_chosen_one_by_one_stay_the_callers(monkeypatch):
    def cannot_tell() -> str:
        raise RuntimeError("mix of the legacy and new APIs")

    def changed(_: str) -> None:
        raise AssertionError

    monkeypatch.setattr(torch, "get_float32_matmul_precision", cannot_tell)
    monkeypatch.setattr(torch, "set_float32_matmul_precision", changed)
    with own_modes():
        pass


def test_the_choice_is_back_after_an_error(precisions):
    before = precisions()
    with pytest.raises(ValueError, match="mine"), own_modes():
        raise ValueError("mine")
    assert precisions() == before
