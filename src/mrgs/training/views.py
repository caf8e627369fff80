"""Which view comes next."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


class ViewSampler:
    """Every view once per round, each round in a new random order.

    With several views per step, the views are dealt into as many groups, and each step takes one
    view of each group. In groups that are smaller than others, one view comes twice in a round.

    Args:
        count: number of views.
        generator: of the orders; a checkpoint of it and of ``state()`` continues the sequence
            exactly.
        groups: views per step, at most as many as there are.
    """

    def __init__(self, count: int, generator: torch.Generator, groups: int = 1) -> None:
        self._count = count
        self._views = torch.arange(count)
        self._generator = generator
        self._groups = groups
        self._waiting = torch.empty(0, dtype=torch.int64)

    def restrict(self, views: Sequence[int]) -> None:
        """From the next round on, show only these.

        Raises:
            ValueError: there are several groups, which are dealt from all views.
        """
        if self._groups > 1:
            raise ValueError("groups of views cannot be restricted")
        self._views = torch.tensor(views)

    def next(self) -> list[int]:
        """The views of the next step, one of each group."""
        if len(self._waiting) == 0:
            self._waiting = self._round()
        chosen, self._waiting = self._waiting[: self._groups], self._waiting[self._groups :]
        return chosen.tolist()

    def peek(self) -> list[int]:
        """The views that ``next`` will return; none at the end of a round, since the following one
        is not drawn yet."""
        return self._waiting[: self._groups].tolist()

    def _round(self) -> Tensor:
        """The views of a round, step after step."""
        longest = -(-len(self._views) // self._groups)
        orders = []
        for first in range(self._groups):
            group = self._views[first :: self._groups]
            order = group[torch.randperm(len(group), generator=self._generator)]
            orders.append(torch.cat([order, order[: longest - len(order)]]))
        return torch.stack(orders, dim=1).flatten()

    def state(self) -> Tensor:
        """The rest of the running round."""
        return self._waiting.clone()

    def load(self, waiting: Tensor) -> None:
        """Continue with the rest of a round.

        Raises:
            ValueError: it names a view that does not exist, a view of another group, or one twice.
        """
        is_list = waiting.dtype == torch.int64 and waiting.dim() == 1
        if not is_list or not set(waiting.tolist()) <= set(range(self._count)):
            raise ValueError(f"the round is not one of {self._count} views")
        steps, rest = divmod(len(waiting), self._groups)
        groups = torch.arange(self._groups).repeat(steps)
        if rest or not torch.equal(waiting % self._groups, groups):
            raise ValueError(f"the round is not one of {self._groups} views per step")
        if self._groups == 1 and len(waiting.unique()) < len(waiting):
            raise ValueError("the round names a view twice")
        self._waiting = waiting
