"""What torchrun tells a process about itself; loads no torch."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import NamedTuple

from mrgs.system.threads import available_cores


class Launch(NamedTuple):
    """A process among those that one ``torchrun`` has started.

    Attributes:
        rank: its number among all processes, from 0.
        world_size: how many there are on all machines.
        local_world_size: how many there are on this machine.
        local_rank: its number among those.
    """

    rank: int
    world_size: int
    local_world_size: int
    local_rank: int

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> Launch | None:
        """This process's place; None if torchrun has not started it."""
        if "TORCHELASTIC_RUN_ID" not in environment:
            return None
        names = ("RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE", "LOCAL_RANK")
        return cls(*(int(environment[name]) for name in names))

    @property
    def is_first(self) -> bool:
        """Whether this process writes the files and speaks to the user."""
        return self.rank == 0

    @property
    def threads(self) -> int:
        """This process's share of the machine's cores."""
        return max(1, available_cores() // self.local_world_size)

    def gpu(self, count: int) -> int:
        """The number of this process's GPU among those of its machine: each has its own, as far as
        there are enough."""
        return self.local_rank % count

    def share_cores(self) -> None:
        """Restrict torch and Numba, which must not be loaded yet, to this process's share of the
        cores.

        torchrun sets OMP_NUM_THREADS to 1 where the user has not set it. Any other number, and
        NUMBA_NUM_THREADS, are the user's and stay.
        """
        if os.environ.get("OMP_NUM_THREADS", "1") == "1":
            os.environ["OMP_NUM_THREADS"] = os.environ.get("NUMBA_NUM_THREADS", str(self.threads))
        os.environ.setdefault("NUMBA_NUM_THREADS", str(self.threads))
