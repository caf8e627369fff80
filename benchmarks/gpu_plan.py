"""What the GPU benchmark measures: sizes and efforts of the full run, the quick one, and the trial
without a GPU."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from benchmarks.plan import Effort

PARTS = {
    "correctness": "against the oracle in double precision",
    "gsplat": "rasterizer beside gsplat, which blends one opacity per pass",
    "rasterizer": "rasterizer, both modalities in one pass",
    "step": "whole training step",
    "training": "training of the bundled scene",
}
"""By name, in the order in which they run: the training takes what time the others leave."""

FORWARD = "forward"
FORWARD_BACKWARD = "forward + backward"
RECORDED = "recorded"
"""What is timed of a pass; recorded, forward and backward run as in a training on a GPU."""

SCENE = Path(__file__).parents[1] / "examples" / "tabletop"
"""The bundled scene, which is trained."""

TRAINED_GAUSSIANS = 47_000
"""At most, of the trainings: the number that the paper reports."""

Size = tuple[int, int, int]
"""Gaussians, and the image's width and height in pixels."""


@dataclass(frozen=True)
class Plan:
    """How much is measured.

    Attributes:
        sizes: of the rasterizer, alone and beside gsplat.
        effort: of each of them.
        scenes: random scenes that are compared with the oracle.
        largest_scene: of them, the largest.
        neighbours: numbers of points whose neighbours are searched.
        step_sizes: of the whole step.
        methods: whose step is measured.
        steps: how often.
        trainings: methods with which the bundled scene is trained, one after the other.
        training_steps: length of their schedule.
        resolution: photos wider than so many pixels are reduced; None keeps them.
        matrix: side of the matrices that show what the device can do at most.
    """

    sizes: tuple[Size, ...]
    effort: Effort
    scenes: int
    largest_scene: Size
    neighbours: tuple[int, ...]
    step_sizes: tuple[Size, ...]
    methods: tuple[str, ...]
    steps: Effort
    trainings: tuple[str, ...]
    training_steps: int
    resolution: int | None
    matrix: int


FULL = Plan(
    sizes=(
        (50_000, 640, 480),
        (200_000, 640, 480),
        (200_000, 1920, 1080),
        (1_000_000, 1920, 1080),
    ),
    effort=Effort(runs=60, seconds=2.0, fewest=10, warm_up=5),
    scenes=24,
    largest_scene=(2_000, 321, 243),
    neighbours=(3, 1_000, 50_000),
    step_sizes=((50_000, 640, 480), (1_000_000, 1920, 1080)),
    methods=("mrgs", "mrgs-plus", "3dgs-rgbt"),
    steps=Effort(runs=200, seconds=2.0, fewest=20, warm_up=20),
    trainings=("mrgs", "3dgs-rgbt", "mrgs-plus"),
    training_steps=30_000,
    resolution=None,
    matrix=8192,
)
QUICK = dataclasses.replace(
    FULL,
    sizes=((50_000, 640, 480), (200_000, 1920, 1080)),
    effort=Effort(runs=30, seconds=1.0, fewest=10, warm_up=3),
    scenes=6,
    methods=("mrgs",),
    steps=Effort(runs=100, seconds=3.0, fewest=20, warm_up=10),
    step_sizes=((50_000, 640, 480),),
    trainings=("mrgs",),
    training_steps=1_500,
)
TRIAL = Plan(
    sizes=((300, 64, 48),),
    effort=Effort(runs=2, seconds=0.0, fewest=2, warm_up=1),
    scenes=3,
    largest_scene=(40, 37, 29),
    neighbours=(3, 100),
    step_sizes=((300, 64, 48),),
    methods=("mrgs", "mrgs-plus"),
    steps=Effort(runs=2, seconds=0.0, fewest=2, warm_up=1),
    trainings=("mrgs",),
    training_steps=3,
    resolution=32,
    matrix=64,
)
PLANS = {"full": FULL, "quick": QUICK, "trial": TRIAL}
