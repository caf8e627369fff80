"""What is measured: one number grows, the others stay; and cases for the estimate of the memory."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace

from mrgs.method.config import TrainConfig, make_config

FEWEST_STEPS = 12
"""Of a training: with two densifications, and enough steps between them to time."""

SMALLEST, LARGEST = (160, 120), (4000, 3000)


@dataclass(frozen=True)
class Case:
    """A short training in a process of its own.

    Attributes:
        axis: what grows ("gaussians", "photos", "pixels" or "threads"); "estimate" for the cases
            that compare methods.
        gaussians: N, from the first step on.
        photos: pairs of photos, each of which is read and, while there is room, kept.
        size: width and height of both photos of a pair, which share a camera.
        threads: of torch and Numba.
        method: what is trained.
    """

    axis: str
    gaussians: int = 50_000
    photos: int = 16
    size: tuple[int, int] = (640, 480)
    threads: int = 1
    method: str = "mrgs-plus"

    @property
    def steps(self) -> int:
        """Each photo is seen once."""
        return max(self.photos, FEWEST_STEPS)

    @property
    def x(self) -> int:
        """The number that grows along the axis."""
        width, height = self.size
        found: int = width * height if self.axis == "pixels" else getattr(self, self.axis)
        return found

    def config(self) -> TrainConfig:
        """The method's preset ``fast`` in so many steps at full resolution, all degrees of the
        harmonics in use, the Gaussians at their cap and densified in the middle and at the end."""
        config = make_config(
            self.method, "fast", max_steps=self.steps, max_gaussians=self.gaussians
        )
        density = replace(config.densification, start=1, stop=self.steps, every=self.steps // 2)
        return replace(
            config, coarse_until=0.0, sh_every=1, checkpoint_every=self.steps, densification=density
        )


AXES = {
    "gaussians": [
        Case("gaussians", gaussians=count)
        for count in (20_000, 50_000, 100_000, 200_000, 500_000, 1_000_000, 2_000_000)
    ],
    "photos": [Case("photos", 20_000, photos=count, size=SMALLEST) for count in (50, 500, 5_000)],
    "pixels": [
        Case("pixels", size=size)
        for size in ((320, 240), (640, 480), (1280, 960), (2560, 1920), LARGEST)
    ],
    "threads": [Case("threads", threads=threads) for threads in (1, 2)],
}

METHODS = ("mrgs", "mrgs-plus", "3dgs-rgbt")
ESTIMATES = [
    *(
        Case("estimate", count, size=size, method=method)
        for method in METHODS
        for count, size in (
            (20_000, SMALLEST),
            (50_000, (320, 240)),
            (200_000, SMALLEST),
            (200_000, (640, 480)),
        )
    ),
    *(Case("estimate", 20_000, photos=200, method=method) for method in METHODS),
]
"""Few photos first, then many."""

GROUPS = {**AXES, "estimate": ESTIMATES}


def case_to_json(case: Case) -> dict[str, object]:
    """What ``case_from_json`` reads."""
    return dataclasses.asdict(case)


def case_from_json(entry: dict) -> Case:
    """The case that ``case_to_json`` wrote."""
    return Case(**{**entry, "size": tuple(entry["size"])})
