"""How many threads compute, and processes that lack them because they were forked."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from mrgs.errors import MrgsError


def available_cores() -> int:
    """The cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def waiting_factor() -> float:
    """How many times as long work on all cores takes if other programs go on as in the last minute:
    1 where they do nothing, or it is not known."""
    try:
        return 1 + os.getloadavg()[0] / (os.cpu_count() or 1)
    except (AttributeError, OSError):  # not on Windows, nor everywhere else
        return 1.0


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute on the calling thread alone for a while: for small work, threads that wait for each
    other in busy loops take several times the processor time, and are no sooner done where another
    program has a core."""
    import numba
    import torch

    threads = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads[0])
        numba.set_num_threads(threads[1])


_computes: int | None = None
"""The process in which this package first computed; a fork inherits it."""


def require_own_threads() -> None:
    """To be called before something is computed: the threads of torch and Numba do not survive a
    fork, and the child would wait for them forever, or be ended by Numba. MrgsError if this process
    was forked from one that has computed."""
    if _computes not in (None, os.getpid()):
        raise MrgsError(
            "this process was forked from one that has computed, whose threads it lacks: start "
            "processes with multiprocessing.get_context('spawn')"
        )


def will_compute() -> None:
    """To be called where this process begins to train, to load a run or to render: from now on its
    forks must not. Raises as ``require_own_threads``."""
    global _computes
    require_own_threads()
    _computes = os.getpid()
