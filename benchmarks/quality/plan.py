"""What is trained: variants in turns, on every scene with every seed."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

WORKING_TREE = "now"
"""Stands for the code as it is on disk, instead of a commit."""


@dataclass(frozen=True)
class Variant:
    """One way to train.

    Attributes:
        method: as in ``mrgs train --method``.
        preset: as in ``--preset``.
        commit: whose code trains and scores; ``WORKING_TREE`` for the code on disk.
        change: name of a YAML file with changed values, without its folder and suffix; "" for none.
    """

    method: str
    preset: str
    commit: str = WORKING_TREE
    change: str = ""

    @property
    def name(self) -> str:
        """As tables and charts show it."""
        parts = [self.method, self.preset, self.change]
        code = [] if self.commit == WORKING_TREE else [f"@{self.commit}"]
        return " ".join(part for part in [*parts, *code] if part)


@dataclass(frozen=True)
class Job:
    """One training.

    Attributes:
        variant: how.
        scene: the scene's folder, as it was given.
        seed: of its random choices.
    """

    variant: Variant
    scene: str
    seed: int


@dataclass(frozen=True)
class Point:
    """A model on its way.

    Attributes:
        step: after which it was scored.
        cpu_s: processor seconds of the training until then: loading, start points and checkpoints
            are part of it, compiling and scoring are not.
        wall_s: seconds by the clock, likewise.
        gaussians: N.
        scores: mean over the held-out views, by name: "thermal" and "rgb" (PSNR in dB), "error"
            (of the temperatures against the exact ones, over the camera's own; only for scenes that
            know them).
    """

    step: int
    cpu_s: float
    wall_s: float
    gaussians: int
    scores: dict[str, float]


@dataclass(frozen=True)
class Curve:
    """The points of one training, in the order of their steps."""

    job: Job
    points: list[Point]


SMALLER_IS_BETTER = frozenset({"error"})


def variants_of(
    methods: Sequence[str], presets: Sequence[str], commits: Sequence[str], changes: Sequence[str]
) -> list[Variant]:
    """Every combination, the first of each list first."""
    return [Variant(*parts) for parts in itertools.product(methods, presets, commits, changes)]


def jobs_of(variants: Sequence[Variant], scenes: Sequence[str], seeds: int) -> list[Job]:
    """All trainings in turns: whatever slows the machine for a while meets every variant."""
    return [
        Job(variant, scene, seed)
        for seed in range(seeds)
        for scene in scenes
        for variant in variants
    ]


def time_until(points: Sequence[Point], score: str, target: float, clock: str) -> float | None:
    """Seconds until a score first reaches a target, on a line between the points; None if it never
    does or is not known.

    Args:
        points: of one training.
        score: its name.
        target: to reach from the worse side.
        clock: "cpu_s" or "wall_s".
    """
    sign = -1.0 if score in SMALLER_IS_BETTER else 1.0
    known = [point for point in points if score in point.scores]
    before: Point | None = None
    for point in known:
        missing = sign * (target - point.scores[score])
        if missing <= 0:
            if before is None:
                return float(getattr(point, clock))
            gained = sign * (point.scores[score] - before.scores[score])
            share = 1 + missing / gained
            start, end = getattr(before, clock), getattr(point, clock)
            return float(start + share * (end - start))
        before = point
    return None


def curve_to_json(curve: Curve) -> dict[str, object]:
    """What ``curve_from_json`` reads."""
    return dataclasses.asdict(curve)


def curve_from_json(entry: dict[str, Any]) -> Curve:
    """The curve that ``curve_to_json`` wrote."""
    job, points = entry["job"], entry["points"]
    variant = Variant(**job["variant"])
    return Curve(Job(variant, job["scene"], job["seed"]), [Point(**point) for point in points])
