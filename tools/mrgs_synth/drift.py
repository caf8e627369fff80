"""The drift of an uncooled thermal camera over a series of photos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Drift:
    """What the readings of a whole photo are off by, photo after photo.

    Attributes:
        ramp_c: between two corrections with its shutter the camera drifts steadily from so much
            below to as much above, or the other way round, °C.
        shutter_s: between two corrections.
        photo_s: the least and the most time between two photos, at random.
        jump_c: standard deviation of the error that each correction leaves, °C.
        pauses: how often the photographer pauses, between photos at random.
        pause_s: length of a pause.
        rest_c: what a camera that starts, or wakes after a pause, is off by at first, °C.
        settle_s: after so long, 1/e of that is left.
    """

    ramp_c: float = 0.0
    shutter_s: float = 180.0
    photo_s: tuple[float, float] = (8.0, 20.0)
    jump_c: float = 0.0
    pauses: int = 0
    pause_s: float = 300.0
    rest_c: float = 0.0
    settle_s: float = 240.0

    def series(
        self, count: int, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """When photos are taken, seconds after a correction, and the offset of each, °C."""
        start = rng.uniform(0, self.shutter_s)
        taken = start + rng.uniform(*self.photo_s, count).cumsum()
        woken = np.full(count, taken[0])
        if self.pauses:
            first_after = np.sort(
                rng.choice(np.arange(1, count), min(self.pauses, count - 1), False)
            )
            for photo in first_after:
                taken[photo:] += self.pause_s
                woken[photo:] = taken[photo]
        corrections = (taken // self.shutter_s).astype(int)
        ends = rng.choice([-self.ramp_c, self.ramp_c], size=int(corrections[-1]) + 1)
        left = rng.normal(0.0, self.jump_c, len(ends))
        ramp = ends[corrections] * (2 * (taken % self.shutter_s) / self.shutter_s - 1)
        resting = self.rest_c * np.exp((woken - taken) / self.settle_s)
        return taken, ramp + left[corrections] + resting
