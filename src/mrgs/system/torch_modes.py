"""torch as the method needs it, whatever the caller has set."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

import torch

from mrgs.errors import ConfigError


@contextmanager
def own_modes() -> Iterator[None]:
    """Within this block gradients are recorded, ``torch.inference_mode`` is off, and backward
    passes run in this thread; all of that for this thread. Products of float32 have its precision,
    in the whole process.

    On a GPU, backward passes would run in another thread, and to wake that one and then this one
    takes longer than many a pass (docs/decisions, 052). The default type of tensors is the whole
    process's: changed here, it would change under the caller's other threads.

    Raises:
        ConfigError: the default type is not float32.
    """
    chosen = torch.get_default_dtype()
    if chosen != torch.float32:
        raise ConfigError(
            f"torch's default type is {chosen}, and training and rendering need float32: call "
            f"torch.set_default_dtype(torch.float32) before"
        )
    with (
        torch.inference_mode(False),
        torch.enable_grad(),
        torch.autograd.set_multithreading_enabled(False),
        _full_precision.held(),
    ):
        yield


class _FullPrecision:
    """Products and convolutions of float32 that are not rounded to fewer digits.

    torch rounds the operands of cuDNN's convolutions to 10 bits (TF32) by default, and on request
    those of all products. A kernel would then differ from its plain definition by more than the
    check of kernels allows. The setting is the process's: it is the caller's again when no thread
    needs it any more.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._holders = 0
        self._before: tuple[bool, str] | None = None

    @contextmanager
    def held(self) -> Iterator[None]:
        """Within this block."""
        with self._lock:
            self._holders += 1
            if self._holders == 1:
                self._begin()
        try:
            yield
        finally:
            with self._lock:
                self._holders -= 1
                if self._holders == 0:
                    self._end()

    def _begin(self) -> None:
        try:
            self._before = torch.backends.cudnn.allow_tf32, torch.get_float32_matmul_precision()
        except RuntimeError:
            # The caller has chosen precisions one by one, which torch does not tell of in this way
            # (from 2.9 on).
            self._before = None
            return
        _set_precision(False, "highest")

    def _end(self) -> None:
        if self._before is not None:
            _set_precision(*self._before)


def _set_precision(convolutions_rounded: bool, products: str) -> None:
    torch.backends.cudnn.allow_tf32 = convolutions_rounded
    torch.set_float32_matmul_precision(products)


_full_precision = _FullPrecision()
