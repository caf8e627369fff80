"""What a pipeline is going to do, how long that takes, and whether the computer suffices for it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from mrgs.errors import ConfigError, RunError
from mrgs.export.las import require_laspy
from mrgs.pipeline.computer import Computer
from mrgs.pipeline.costs import Cost, Workload, reduced
from mrgs.pipeline.intake import Intake
from mrgs.pipeline.quality import Quality
from mrgs.prepare.options import PrepareOptions
from mrgs.prepare.sfm.process import check_version, installed_version
from mrgs.scene import THERMAL
from mrgs.system.room import free_disk
from mrgs.training.memory import training_bytes
from mrgs.training.photos import bytes_per_pixel


@dataclass(frozen=True)
class PlannedStage:
    """A stage of a pipeline.

    Attributes:
        name: such as "train".
        number: from 1.
        total: number of stages.
        parts: seconds that its parts are expected to take, by name.
        is_done: whether an earlier call has finished it, with the same inputs and settings.
    """

    name: str
    number: int
    total: int
    parts: Mapping[str, float]
    is_done: bool

    @property
    def seconds(self) -> float:
        """Time that it is expected to take; 0 if it is done."""
        return 0.0 if self.is_done else sum(self.parts.values())


@dataclass(frozen=True)
class PipelinePlan:
    """What a pipeline is going to do.

    Attributes:
        intake: what the folder holds.
        quality: of the model.
        computer: that does the work.
        device: what trains and renders, such as "cpu" or a GPU's name.
        output: folder of all results.
        stages: in order.
        memory: bytes that are needed at most, roughly.
        disk: bytes that the results need, roughly.
        notes: sentences for the user.
    """

    intake: Intake
    quality: Quality
    computer: Computer
    device: str
    output: Path
    stages: tuple[PlannedStage, ...]
    memory: int
    disk: int
    notes: tuple[str, ...] = ()

    @property
    def seconds(self) -> float:
        """Time that all stages are expected to take."""
        return sum(stage.seconds for stage in self.stages)


def planned_seconds(cost: Cost, computer: Computer) -> dict[str, float]:
    """The time that the parts of a stage take on a computer."""
    return {part: computer.seconds(each, cost.parallel) for part, each in cost.parts.items()}


def require_extras(intake: Intake, options: PrepareOptions) -> tuple[str, ...]:
    """Check that what the stages need is installed.

    Returns:
        Sentences about what is left out for want of an extra.

    Raises:
        ConfigError: an extra is missing that a stage cannot do without.
    """
    if intake.kind == "photos" and options.poses is None:
        check_version(installed_version())
    try:
        require_laspy()
    except ConfigError as error:
        return (f"the export las is left out: {error}",)
    return ()


def require_disk(needed: int, output: Path) -> None:
    """Check that the results fit on the disk.

    Raises:
        RunError: they do not.
    """
    free = free_disk(output)
    if free < needed:
        raise RunError(
            f"{output}: the results need about {needed / 1e9:.1f} GB, and {free / 1e9:.1f} GB are "
            f"free; make room, or choose a folder on another disk",
            options=("output",),
        )


def disk_bytes(work: Workload, intake: Intake) -> int:
    """Bytes that a pipeline writes, roughly: the scene, two checkpoints, renderings, exports."""
    thermal = intake.sizes.get(THERMAL, (0, 0))
    scene = 0
    if work.photos:
        features = 1_000_000 * work.views
        scene = intake.bytes + 4 * thermal[0] * thermal[1] * work.views + features
    model = (3 * 1_100 + 1_500) * work.gaussians
    images = int(1e3 * work.kpx) * (12 * (work.held_out or work.views) + 2 * work.views)
    return int(1.2 * (scene + model + images)) + 50_000_000


def needed_memory(work: Workload, intake: Intake, quality: Quality) -> int:
    """Bytes of memory that training needs at most, roughly."""
    bytes_each = sum(
        bytes_per_pixel(modality) * math.prod(reduced(size, quality.resolution))
        for modality, size in intake.sizes.items()
    )
    return training_bytes(
        quality.config(),
        intake.sizes,
        work.gaussians,
        pixels=round(1e3 * work.kpx),
        photo_bytes=bytes_each * (work.views - work.held_out),
        compiles=work.compiling_s > 0,
    )
