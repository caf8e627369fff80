"""torch's modes within a training and a rendering, whatever the caller has set."""

from __future__ import annotations

import threading
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
