"""Commands that torchrun has started in several processes: the first one speaks, the others are
silent."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from typing import TYPE_CHECKING

from mrgs.app.interrupts import Interruption, interrupts
from mrgs.distributed.launch import Launch
from mrgs.errors import MrgsWarning

if TYPE_CHECKING:
    from mrgs.distributed.processes import Processes
    from mrgs.scene import Scene
    from mrgs.training.driver import Statistics
    from mrgs.training.run_folder import RunConfig


@contextmanager
def silenced(launch: Launch | None) -> Iterator[None]:
    """Within this block a process that is not the first shows no warnings."""
    if launch is None or launch.is_first:
        yield
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MrgsWarning)
        yield


@contextmanager
def muted(launch: Launch | None) -> Iterator[None]:
    """Within this block a process that is not the first prints nothing: the first one says the
    same."""
    if launch is None or launch.is_first:
        yield
        return
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        yield


@contextmanager
def processes_of(launch: Launch | None) -> Iterator[Processes | None]:
    """Within this block the processes that torchrun has started are connected; None without it."""
    if launch is None:
        yield None
        return
    launch.share_cores()
    from mrgs.distributed.processes import joined

    with joined(launch) as processes:
        yield processes


class FollowingProgress:
    """Takes the place of ``TrainingProgress`` in a process that is not the first: shows nothing,
    and ends the training after a step on which all agree."""

    def __init__(self) -> None:
        self._is_asked = False
        self._postponed = ExitStack()

    def __enter__(self) -> None:
        self._postponed.__enter__()

    def __exit__(self, *_: object) -> None:
        self._postponed.close()

    def start(self, scene: Scene, config: RunConfig) -> None:
        """From here on interruptions wait for the end of a step."""
        self._postponed.enter_context(interrupts.postponed(self._interrupt))

    def step(self, statistics: Statistics) -> bool:
        """Whether this process asks the others to stop."""
        return self._is_asked

    def _interrupt(self, interruption: Interruption) -> None:
        self._is_asked = True
