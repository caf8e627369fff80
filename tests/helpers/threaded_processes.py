"""Processes of a torchrun that are threads of the test: what they exchange lies in memory."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from mrgs.distributed.launch import Launch
from mrgs.distributed.processes import Processes
from mrgs.errors import MrgsError

HOST = torch.device("cpu")


class Board:
    """Where each of several threads puts something that all then read."""

    def __init__(self, count: int) -> None:
        self._slots: list[Any] = [None] * count
        self._barrier = Barrier(count, timeout=300)

    def exchange(self, rank: int, value: Any) -> list[Any]:
        self._slots[rank] = value
        self._barrier.wait()
        found = list(self._slots)
        self._barrier.wait()
        return found

    def leave(self) -> None:
        """The others wait no longer."""
        self._barrier.abort()


class ThreadedProcesses(Processes):
    """One of several threads."""

    def __init__(self, launch: Launch, store: dist.Store, board: Board) -> None:
        super().__init__(launch, store)
        self._board = board

    @property
    def device(self) -> torch.device:
        return HOST

    def share_tensor(self, tensor: Tensor) -> Tensor:
        return self._board.exchange(self.rank, tensor)[0].clone()

    def all_gather(self, tensor: Tensor) -> Tensor:
        return torch.stack(self._board.exchange(self.rank, tensor))

    def all_to_all(self, rows: Tensor, sent: list[int], received: list[int]) -> Tensor:
        pieces = self._board.exchange(self.rank, rows.split(sent))
        assert [len(piece[self.rank]) for piece in pieces] == received
        return torch.cat([piece[self.rank] for piece in pieces])


def together(
    action: Callable[[Processes], Any], count: int = 3, store: dist.Store | None = None
) -> list[Any]:
    """What an action returns, or raises, on each of several processes."""
    shared, board = store or dist.HashStore(), Board(count)

    def one(rank: int) -> Any:
        try:
            return action(ThreadedProcesses(Launch(rank, count, count, rank), shared, board))
        except MrgsError as error:  # on which all agree
            return error
        except Exception:
            board.leave()
            raise

    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(one, range(count)))
