"""torch's modes and random numbers as the method needs them, whatever the caller has set."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import Any, NamedTuple

import torch

from mrgs.errors import ConfigError
from mrgs.system.gpu import HOST


@contextmanager
def own_modes(device: torch.device = HOST) -> Iterator[None]:
    """Within this block, for this thread, gradients are recorded, ``torch.inference_mode`` and
    autocast are off, new tensors are on the CPU unless a device is given, and backward passes run
    in this thread; and in the whole process, float32 products and convolutions use full precision
    (no TF32).

    On a GPU, backward passes would run in another thread, and to wake that one and then this one
    takes longer than many a pass (docs/decisions, 052). The default type of tensors is the whole
    process's too: changed here, it would change under the caller's other threads. ConfigError if
    the default type is not float32. A GPU as ``device`` is made the current CUDA device within the
    block."""
    chosen = torch.get_default_dtype()
    if chosen != torch.float32:
        raise ConfigError(
            f"torch's default type is {chosen}, and training and rendering need float32: call "
            f"torch.set_default_dtype(torch.float32) before"
        )
    with ExitStack() as stack:
        stack.enter_context(torch.inference_mode(False))
        stack.enter_context(torch.enable_grad())
        stack.enter_context(torch.autograd.set_multithreading_enabled(False))
        stack.enter_context(_full_precision())
        for kind in ("cpu", "cuda"):
            if torch.is_autocast_enabled(kind):
                stack.enter_context(torch.autocast(kind, enabled=False))
        if torch.empty(0).device != HOST:  # of a context, too, which has no other name before 2.8
            stack.enter_context(HOST)
        if device.type == "cuda":
            stack.enter_context(torch.cuda.device(device))
        yield


@contextmanager
def _full_precision() -> Iterator[None]:
    """Within this block, operands of float32 products and convolutions are not rounded (no TF32, no
    bfloat16), as torch does in cuDNN's convolutions, or on request: a kernel would differ from its
    plain definition. The process's settings are restored after it."""
    before = []
    for setting in _SETTINGS:
        # Where the operations behind a common name have different settings, torch raises.
        with suppress(RuntimeError):
            before.append((setting, setting.get()))
    try:
        for setting, _ in before:
            setting.set(setting.exact)
        yield
    finally:
        for setting, value in before:
            setting.set(value)


class _Setting(NamedTuple):
    """One of torch's precisions, and its value without rounding."""

    get: Callable[[], Any]
    set: Callable[[Any], None]
    exact: Any


def _settings() -> list[_Setting]:
    """The common names, and from torch 2.9 on the operations' own. As far as they can be read, all
    say the same within ``_full_precision``: else torch would raise where a common name is read."""
    cuda, cudnn = torch.backends.cuda, torch.backends.cudnn
    mkldnn: Any = torch.backends.mkldnn  # its annotations lack the operations
    products = _Setting(
        torch.get_float32_matmul_precision, torch.set_float32_matmul_precision, "highest"
    )
    # Not by its attribute, which ``torch.backends.disable_global_flags`` freezes.
    convolutions = _Setting(torch._C._get_cudnn_allow_tf32, torch._C._set_cudnn_allow_tf32, False)
    common = [convolutions, products]
    with warnings.catch_warnings(), suppress(RuntimeError):
        warnings.simplefilter("ignore")  # torch 2.9 says once that the common names will go
        for setting in common:
            setting.get()
    if not hasattr(cudnn, "conv"):
        return common
    operations = (cuda.matmul, cudnn.conv, cudnn.rnn, mkldnn.matmul, mkldnn.conv)
    name = "fp32_precision"
    return common + [
        _Setting(partial(getattr, each, name), partial(setattr, each, name), "ieee")
        for each in operations
    ]


_SETTINGS = _settings()


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Within this block torch's default generator, from which layers start, follows from a seed;
    after it, it is as it was before."""
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        yield
