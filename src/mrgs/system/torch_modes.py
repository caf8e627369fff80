"""torch as the method needs it, whatever the caller has set."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from mrgs.errors import ConfigError


@contextmanager
def own_modes() -> Iterator[None]:
    """Within this block, for this thread: gradients are recorded, ``torch.inference_mode`` is off,
    and backward passes run in this thread.

    On a GPU they would run in another, and to wake that one and then this one takes longer than
    many a pass (docs/decisions, 052). The default type of tensors is the whole process's: changed
    here, it would change under the caller's other threads.

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
    ):
        yield
