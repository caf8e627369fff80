"""torch's modes within a training and a rendering, whatever the caller has set."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import mrgs
from mrgs.system import torch_modes
from mrgs.system.torch_modes import own_modes, seeded


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
            assert in_other_thread(torch._C._is_multithreading_enabled)
        assert torch.is_inference_mode_enabled()
    assert torch._C._is_multithreading_enabled()


def test_neither_autocast_nor_the_default_device_of_the_caller_matters():
    ones = torch.ones(2, 2)
    with torch.autocast("cpu", dtype=torch.bfloat16), torch.device("meta"):
        with own_modes():
            assert (ones @ ones).dtype == torch.float32
            assert torch.ones(2).device.type == "cpu"
        assert (ones @ ones).dtype == torch.bfloat16
        assert torch.ones(2).device.type == "meta"


@pytest.fixture
def current(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The current GPUs, one after the other."""
    chosen = ["cuda:0"]

    @contextmanager
    def device(gpu: torch.device) -> Iterator[None]:
        before = chosen[-1]
        chosen.append(str(gpu))
        yield
        chosen.append(before)

    monkeypatch.setattr(torch.cuda, "device", device)
    return chosen


def test_the_gpu_of_the_computation_is_the_current_one(current):
    with own_modes(torch.device("cuda:1")):
        assert current[-1] == "cuda:1"
    assert current[-1] == "cuda:0"


def test_a_computation_on_the_cpu_leaves_the_current_gpu_alone(current):
    with own_modes():
        pass
    assert current == ["cuda:0"]


def in_other_thread(call: Callable[[], bool]) -> bool:
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(call).result(60)


@pytest.mark.gpu
def test_a_gpus_backward_pass_runs_in_the_thread_that_asks_for_it():
    with own_modes():
        assert backward_thread("cuda") == threading.get_ident()


def told(setting: torch_modes._Setting) -> Any:
    """What torch tells of a setting; None where it cannot."""
    try:
        return setting.get()
    except RuntimeError:
        return None


def precisions() -> list[Any]:
    """What torch is set to."""
    return [told(setting) for setting in torch_modes._SETTINGS]


EXACT = [setting.exact for setting in torch_modes._SETTINGS]


def are_exact() -> bool:
    """Whether nothing is rounded, by all names that can tell."""
    told = zip(precisions(), EXACT, strict=True)
    return all(found in (exact, None) for found, exact in told) and None not in precisions()[2:]


BY_OPERATION = pytest.mark.skipif(
    not hasattr(torch.backends.cudnn, "conv"), reason="torch has them from 2.9 on"
)


def by_operation() -> None:
    torch.backends.cuda.matmul.fp32_precision = "tf32"
    torch.backends.mkldnn.matmul.fp32_precision = "bf16"


def convolutions() -> None:
    torch.backends.cudnn.conv.fp32_precision = "ieee"


def for_all() -> None:
    torch.backends.fp32_precision = "tf32"


CHOICES = [
    lambda: None,
    lambda: torch.set_float32_matmul_precision("medium"),
    lambda: torch.set_float32_matmul_precision("high"),
    lambda: setattr(torch.backends.cudnn, "allow_tf32", False),
    pytest.param(by_operation, marks=BY_OPERATION),
    pytest.param(for_all, marks=BY_OPERATION),
    pytest.param(convolutions, marks=BY_OPERATION),
]


@pytest.fixture
def restored() -> Iterator[None]:
    """torch's settings are as before afterwards."""
    before = precisions()
    yield
    if hasattr(torch.backends, "fp32_precision"):
        torch.backends.fp32_precision = "none"
    torch.set_float32_matmul_precision("highest")
    torch.backends.cudnn.allow_tf32 = True
    for setting, value in zip(torch_modes._SETTINGS, before, strict=True):
        setting.set(value)


@pytest.mark.usefixtures("restored")
@pytest.mark.parametrize("choose", CHOICES)
def test_products_are_not_rounded_and_the_callers_choice_is_back_afterwards(choose):
    choose()
    chosen = precisions()
    with own_modes():
        assert are_exact()
        with own_modes():
            pass
        assert are_exact()
    assert precisions() == chosen
    with pytest.raises(ValueError, match="mine"), own_modes():
        raise ValueError("mine")
    assert precisions() == chosen


def test_where_one_setting_cannot_be_made_the_others_are_the_callers_again(monkeypatch):
    made = ["high"]

    def fails(value: str) -> None:
        if value == "highest":
            raise RuntimeError("not allowed to set flags")

    good = torch_modes._Setting(lambda: made[-1], made.append, "highest")
    broken = torch_modes._Setting(lambda: "high", fails, "highest")
    monkeypatch.setattr(torch_modes, "_SETTINGS", [good, broken])
    for _ in range(2):
        with pytest.raises(RuntimeError, match="not allowed"), own_modes():
            pass
        assert made[-3:] == ["high", "highest", "high"]


@pytest.mark.slow
def test_frozen_flags_of_torch_do_not_matter():
    """In a process of its own: they cannot be thawed."""
    code = (
        "import torch; torch.backends.disable_global_flags()\n"
        "from mrgs.system.torch_modes import own_modes\n"
        "with own_modes(): print(torch._C._get_cudnn_allow_tf32())"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(mrgs.__file__).parents[1])}
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=120
    )
    assert (ran.stdout.strip(), ran.returncode) == ("False", 0), ran.stderr


def test_what_is_drawn_follows_from_the_seed_and_leaves_nothing_behind():
    drawn = []
    for before in (1, 2):
        torch.manual_seed(before)
        state = torch.get_rng_state()
        with seeded(7):
            drawn.append(torch.rand(3))
        assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(*drawn)
    with seeded(8):
        assert not torch.equal(torch.rand(3), drawn[0])
