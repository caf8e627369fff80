"""Which view comes next."""

from __future__ import annotations

import torch
from torch import Tensor


class ViewSampler:
    """Every view once per round, each round in a new random order.

    Args:
        count: number of views.
        generator: of the orders; a checkpoint of it and of ``state()`` continues the sequence
            exactly.
    """

    def __init__(self, count: int, generator: torch.Generator) -> None:
        self._count = count
        self._generator = generator
        self._waiting = torch.empty(0, dtype=torch.int64)

    def next(self) -> int:
        """Index of the next view."""
        if len(self._waiting) == 0:
            self._waiting = torch.randperm(self._count, generator=self._generator)
        index, self._waiting = int(self._waiting[0]), self._waiting[1:]
        return index

    def peek(self) -> int | None:
        """Index of the view after that; None at the end of a round, since the next one is not drawn
        yet."""
        return int(self._waiting[0]) if len(self._waiting) > 0 else None

    def state(self) -> Tensor:
        """The rest of the running round."""
        return self._waiting.clone()

    def load(self, waiting: Tensor) -> None:
        """Continue with the rest of a round.

        Raises:
            ValueError: it names a view that does not exist, or one twice.
        """
        is_list = waiting.dtype == torch.int64 and waiting.dim() == 1
        if not is_list or not set(waiting.tolist()) <= set(range(self._count)):
            raise ValueError(f"the round is not one of {self._count} views")
        if len(waiting.unique()) < len(waiting):
            raise ValueError("the round names a view twice")
        self._waiting = waiting
