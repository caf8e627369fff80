"""Time left of work in parts of different length."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

TRUST = 0.1
"""Share of the whole work after which the measured pace counts as much as the expected one."""

ALMOST_DONE = 0.95
"""A part whose progress is not known counts as done to at most this share."""


def pace_so_far(taken: float, expected: float, whole: float) -> float:
    """Seconds per expected second, as far as what is done can be trusted to tell.

    Args:
        taken: seconds that it took.
        expected: seconds that were expected for it.
        whole: seconds that were expected for all; of little done, the pace says little.
    """
    trust = TRUST * whole
    return (taken + trust) / (expected + trust) if expected + trust > 0 else 1.0


class Forecast:
    """Time left of parts that are done one after another, from their expected lengths and the pace
    so far.

    Args:
        parts: expected length of each part in seconds, by name, in order.
        clock: seconds.
    """

    def __init__(
        self, parts: Mapping[str, float], clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._parts = parts
        self._whole = sum(parts.values())
        self._clock = clock
        self._started = self._part_started = clock()
        self._part = ""

    def left(self, part: str, share: float | None = None) -> float | None:
        """Seconds left; None for a part that is not known.

        Args:
            part: that is being worked on.
            share: of it that is done, 0 to 1; None if that is not known.
        """
        if part not in self._parts:
            return None
        now = self._clock()
        if part != self._part:
            self._part, self._part_started = part, now
        names, length = [*self._parts], self._parts[part]
        before = sum(self._parts[name] for name in names[: names.index(part)])
        if share is None:
            pace = self._pace(before, self._part_started)
            elapsed = now - self._part_started
            share = min(elapsed / (pace * length), ALMOST_DONE) if length > 0 else 0.0
        done = before + share * length
        return self._pace(done, now) * (self._whole - done)

    def _pace(self, done: float, now: float) -> float:
        """Seconds per expected second, once so much is done."""
        return pace_so_far(now - self._started, done, self._whole)
