"""Processes that were forked from one that has computed."""

from __future__ import annotations

import os

from mrgs.errors import MrgsError

_computes: int | None = None
"""The process in which this package first computed; a fork inherits it."""


def require_own_threads() -> None:
    """To be called before something is computed.

    The threads of torch and Numba do not survive a fork: the child would wait for them forever, or
    be ended by Numba.

    Raises:
        MrgsError: this process was forked from one that has computed.
    """
    if _computes not in (None, os.getpid()):
        raise MrgsError(
            "this process was forked from one that has computed, whose threads it lacks: start "
            "processes with multiprocessing.get_context('spawn')"
        )


def will_compute() -> None:
    """To be called where this process begins to train, to load a run or to render: from now on its
    forks must not.

    Raises:
        MrgsError: this process was forked from one that has computed.
    """
    global _computes
    require_own_threads()
    _computes = os.getpid()
