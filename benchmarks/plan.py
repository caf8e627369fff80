"""What is measured: groups of stages, and the numbers of Gaussians and image sizes they are
measured at."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

GAUSSIANS = (10_000, 50_000, 200_000, 500_000)
SIZES = ((320, 240), (640, 480), (1280, 960))

QUICK = ((10_000, (320, 240)), (50_000, (640, 480)))
"""The cases of ``--quick``."""

SMALLEST = (1_000, (64, 48))
"""Big enough to run every line: it warms the caches, and it is the smoke test's."""


@dataclass(frozen=True)
class Case:
    """One group at one size; it runs in a process of its own.

    Attributes:
        group: name of the group.
        gaussians: N; None where the cost does not depend on it.
        width: pixels; None where the cost does not depend on the image.
        height: pixels, likewise.
    """

    group: str
    gaussians: int | None
    width: int | None
    height: int | None

    @property
    def size(self) -> tuple[int, int, int]:
        """N, width and height of a case whose cost depends on all three."""
        if self.gaussians is None or self.width is None or self.height is None:
            raise ValueError(
                f"the group {self.group} does not depend on both the Gaussians and the image"
            )
        return self.gaussians, self.width, self.height


@dataclass(frozen=True)
class Group:
    """Stages that are measured together, in one process per case.

    Attributes:
        name: as ``--only`` takes it.
        title: as the report prints it.
        prepare: ``module:function`` that makes the ``Timing``s of a case; the parent process never
            imports it.
        fixed: the only (N, size) the group is measured at; empty for all that its dependences span.
        by_gaussians: whether the cost depends on N.
        by_pixels: whether it depends on the image's size.
        environment: variables of its processes.
        memory_limit: bytes of address space; None for no limit.
    """

    name: str
    title: str
    prepare: str
    fixed: tuple[tuple[int, tuple[int, int]], ...] = ()
    by_gaussians: bool = True
    by_pixels: bool = True
    environment: dict[str, str] = field(default_factory=dict)
    memory_limit: int | None = None

    def cases(self, quick: bool = False) -> list[Case]:
        """All cases of the group, smallest first, each once."""
        spans = self.fixed or tuple(itertools.product(GAUSSIANS, SIZES))
        return list(dict.fromkeys(self.case(*span) for span in spans if not quick or span in QUICK))

    def case(self, gaussians: int, size: tuple[int, int]) -> Case:
        """The case at this size, without what the cost does not depend on."""
        width, height = size if self.by_pixels else (None, None)
        return Case(self.name, gaussians if self.by_gaussians else None, width, height)


AVX2_ONLY = {
    "ATEN_CPU_CAPABILITY": "avx2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "MKL_ENABLE_INSTRUCTIONS": "AVX2",
}
"""Keeps torch from vectors wider than those of the rasterizer's kernels; the kernels do not read
these."""

_STAGES = "benchmarks.stages"
_PROTOTYPE_CASES = ((50_000, (320, 240)), (50_000, (640, 480)), (200_000, (640, 480)))
_PAPER_CASES = ((50_000, (320, 240)), (50_000, (640, 480)))
_REFERENCE_CASES = ((10_000, (320, 240)), (50_000, (640, 480)))

GROUPS = {
    group.name: group
    for group in (
        Group("rasterizer", "Rasterizer, both modalities", f"{_STAGES}.rasterizer:stages"),
        Group(
            "render",
            "Rendering only, temperatures computed beforehand",
            f"{_STAGES}.training:rendering",
        ),
        Group(
            "losses", "Losses, forward and backward", f"{_STAGES}.losses:stages", by_gaussians=False
        ),
        Group(
            "heads",
            "Heads of the paper preset, forward and backward, all rows",
            f"{_STAGES}.heads:stages",
            by_pixels=False,
        ),
        Group("neighbours", "Neighbours", f"{_STAGES}.heads:neighbours", by_pixels=False),
        Group(
            "densification",
            "Densification event",
            f"{_STAGES}.training:densification",
            by_pixels=False,
        ),
        Group("adam", "Adam over the Gaussians", f"{_STAGES}.training:adam", by_pixels=False),
        Group("mrgs", "Whole step, MrGS", f"{_STAGES}.training:mrgs_step"),
        Group(
            "mrgs-paper",
            "Whole step, MrGS, heads of the paper preset",
            f"{_STAGES}.training:paper_step",
            _PAPER_CASES,
        ),
        Group("3dgs-rgbt", "Whole step, 3DGS_RGB-T", f"{_STAGES}.training:baseline_step"),
        Group("prototype", "Known workloads", f"{_STAGES}.prototype:stages", _PROTOTYPE_CASES),
        Group(
            "prototype-avx2",
            "Known workloads, torch kept to AVX2",
            f"{_STAGES}.prototype:stages",
            _PROTOTYPE_CASES,
            environment=AVX2_ONLY,
        ),
        Group(
            "gsplat",
            "gsplat's plain-torch reference",
            f"{_STAGES}.gsplat_torch:stages",
            _REFERENCE_CASES,
            memory_limit=12 * 2**30,
        ),
    )
}


@dataclass(frozen=True)
class Effort:
    """How often each stage of a case is run.

    Attributes:
        runs: at most.
        seconds: no further round once the case has been measured for so long,
        fewest: but never fewer rounds than these.
        warm_up: rounds that are left out.
    """

    runs: int = 12
    seconds: float = 9.0
    fewest: int = 5
    warm_up: int = 2


QUICK_EFFORT = Effort(runs=10, seconds=1.5, fewest=3, warm_up=1)
ONE_RUN = Effort(runs=1, seconds=0.0, fewest=1, warm_up=0)
