"""What the stages of a pipeline cost: a model of their steps, in processor seconds.

The coefficients were fitted to runs on one core type (decision 029); ``Computer`` translates them
into time on the computer at hand.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mrgs.method.config import TrainConfig
from mrgs.pipeline.intake import Intake, Size
from mrgs.pipeline.quality import Quality
from mrgs.prepare.colmap.pairs import ALIKE, MAX_EXHAUSTIVE, NEIGHBOURS
from mrgs.runs.open import Run
from mrgs.scene import RGB, THERMAL, Scene
from mrgs.training.resolution import coarse_size

FEATURE_PX = 1600 * 1200
"""Larger images are reduced before features are found in them."""

POINTS_PER_VIEW = 450
"""Start points that structure from motion finds per view, roughly."""

MATURE = 0.3
"""Share of the steps after which a model has reached its cap on the Gaussians."""


@dataclass(frozen=True)
class Cost:
    """The cost of a stage.

    Attributes:
        parts: processor seconds by part, in order.
        parallel: share of the work that is spread over the cores.
    """

    parts: Mapping[str, float]
    parallel: float


@dataclass(frozen=True)
class Workload:
    """What a pipeline has to do, as far as its cost depends on it.

    Attributes:
        photos: whether the scene is made from photos.
        finds_poses: whether their poses must be found.
        views: of the scene.
        held_out: of them.
        source_px: pixels of a view's images as they are.
        feature_px: pixels of the images whose features are matched, at most ``FEATURE_PX``.
        kpx: thousands of pixels of a view's images in training, at their full resolution.
        mean_kpx: the same as a mean over the steps, of which the first are coarser.
        start: start points.
        gaussians: at the end.
        steps: of training.
        has_two_cameras: whether a thermal camera must be placed.
        compiling_s: processor seconds for the kernels that no earlier run has left.
    """

    photos: bool
    finds_poses: bool
    views: int
    held_out: int
    source_px: int
    feature_px: int
    kpx: float
    mean_kpx: float
    start: int
    gaussians: int
    steps: int
    has_two_cameras: bool
    compiling_s: float

    @classmethod
    def of(cls, intake: Intake, quality: Quality, compiling_s: float = 0.0) -> Workload:
        """The workload of photos or a scene at a quality."""
        posed = intake.sizes.get(RGB) or intake.sizes[THERMAL]
        points = intake.points
        start = POINTS_PER_VIEW * intake.views if points is None else points
        return cls(
            photos=intake.kind == "photos",
            finds_poses=intake.kind == "photos" and not intake.poses_given,
            views=intake.views,
            held_out=intake.held_out,
            source_px=sum(width * height for width, height in intake.sizes.values()),
            feature_px=min(posed[0] * posed[1], FEATURE_PX),
            kpx=sum(_reduced_px(size, quality.resolution) for size in intake.sizes.values()) / 1e3,
            mean_kpx=mean_kpx(
                [reduced(size, quality.resolution) for size in intake.sizes.values()],
                quality.config(),
            ),
            start=min(start, quality.max_gaussians),
            gaussians=quality.max_gaussians,
            steps=quality.max_steps,
            has_two_cameras=len(intake.sizes) > 1,
            compiling_s=compiling_s,
        )

    @classmethod
    def of_run(cls, run: Run, scene: Scene) -> Workload:
        """The workload of a trained model."""
        pixels = sum(camera.width * camera.height for camera in scene.train[0].cameras.values())
        return cls(
            photos=False,
            finds_poses=False,
            views=len(scene.train) + len(scene.eval),
            held_out=len(scene.eval),
            source_px=pixels,
            feature_px=0,
            kpx=pixels / 1e3,
            mean_kpx=pixels / 1e3,
            start=len(scene.points.positions),
            gaussians=run.gaussian_count,
            steps=run.config.max_steps,
            has_two_cameras=len(scene.modalities) > 1,
            compiling_s=0.0,
        )

    @property
    def mean_gaussians(self) -> float:
        """Over the training, see ``mean_gaussians``."""
        return mean_gaussians(self.start, self.gaussians)


def _reduced_px(size: Size, resolution: int) -> float:
    return size[0] * size[1] * min(1.0, resolution / size[0]) ** 2


def reduced(size: Size, resolution: int) -> Size:
    """The size of an image in training, at its full resolution."""
    width, height = size
    scale = min(1.0, resolution / width)
    return round(scale * width), round(scale * height)


def mean_gaussians(start: int, most: int) -> float:
    """Mean number of Gaussians over a training: a ramp from the start to the cap, then the cap."""
    return MATURE * (start + most) / 2 + (1 - MATURE) * most


def mean_kpx(sizes: Sequence[Size], config: TrainConfig) -> float:
    """Thousands of pixels of images of these sizes, as a mean over the steps of a training."""
    shares = Counter(config.pixel_size_at(step) for step in range(1, config.max_steps + 1))
    return sum(
        count / config.max_steps * math.prod(coarse_size(*size, pixel_size)) / 1e3
        for pixel_size, count in shares.items()
        for size in sizes
    )


def stage_costs(work: Workload) -> dict[str, Cost]:
    """The cost of each stage by its name, in order."""
    views, kgauss = work.views, work.gaussians / 1e3
    render = _render(work, kgauss)
    return {
        "prepare" if work.photos else "check": Cost(_prepare(work), 0.6),
        "train": Cost(_train(work), 0.5),
        "score": Cost({"scoring": 1.0 + work.held_out * (8 * render + 0.2e-3 * work.kpx)}, 0.4),
        "render": Cost({"rendering": (work.held_out or views) * (render + 0.5e-3 * work.kpx)}, 0.2),
        "report": Cost(
            {
                "anomalies": 1.0 + views * (2 * render + 0.1e-3 * work.kpx),
                "measurements and pictures": 4.0 + _map(work, render),
                "scores and page": 1.0,
            },
            0.4,
        ),
        "page": Cost(_page(work, render), 0.4),
        "exports": Cost(_exports(work, render), 0.4),
    }


def _render(work: Workload, kgauss: float) -> float:
    """Rendering one view, both modalities."""
    return 4e-3 + 0.6e-3 * kgauss + 0.06e-3 * work.kpx


def _prepare(work: Workload) -> dict[str, float]:
    reading = work.views * (0.02 + 0.04e-6 * work.source_px)
    if not work.photos:
        return {"reading images": reading}
    return {
        "pairs": 0.1 + 0.005 * work.views,
        "images": reading,
        **(_poses(work) if work.finds_poses else {}),
        "thermal camera": 0.9 * work.views if work.has_two_cameras else 0.0,
        "page": 2.0 + 0.02 * work.views,
    }


def _poses(work: Workload) -> dict[str, float]:
    """Structure from motion."""
    pairs = min(work.views, MAX_EXHAUSTIVE) * (min(work.views, MAX_EXHAUSTIVE) - 1) / 2
    if work.views > MAX_EXHAUSTIVE:
        pairs = work.views * (NEIGHBOURS + ALIKE)
    return {
        "features": 1.5e-6 * work.feature_px * work.views,
        "matching": 0.12 * pairs,
        "mapping": 0.35 * work.views,
    }


def _train(work: Workload) -> dict[str, float]:
    step = step_cost(work.mean_gaussians, work.mean_kpx)
    return {"compiling": 3.0 + work.compiling_s, "steps": step * work.steps}


def step_cost(gaussians: float, kpx: float) -> float:
    """Processor seconds of a training step.

    Args:
        gaussians: how many.
        kpx: thousands of pixels of the view's images.
    """
    return 0.014 + 1.55e-3 * gaussians / 1e3 + 0.2e-3 * kpx


def _page(work: Workload, render: float) -> dict[str, float]:
    return {"baking": 0.5 + work.views * 2e-3 + work.held_out * 2 * render, "page": 0.5}


def _exports(work: Workload, render: float) -> dict[str, float]:
    kgauss = work.gaussians / 1e3
    surface = _surface(work, render)
    return {
        "baking": 0.5 + work.views * 2e-3 + work.held_out * 2 * render,
        "ply": 0.01 * kgauss,
        "spz": 0.01 * kgauss,
        "glb": 0.01 * kgauss,
        "splat": 0.03 * kgauss,
        "points": surface,
        "las": 0.05 * kgauss,
        "mesh": 3.0 + 3 * surface,
        "cameras": work.views * (0.005 + 0.2e-3 * work.kpx),
        "ortho": _map(work, render),
        "elevation": 1.0 + surface,
    }


def _surface(work: Workload, render: float) -> float:
    """Finding what all views see of the surface."""
    return work.views * (render + 0.1e-3 * work.kpx)


def _map(work: Workload, render: float) -> float:
    """A map in °C; also in the report, where the scene has metres and one side or is flown over."""
    return 1.0 + 3 * _surface(work, render)
