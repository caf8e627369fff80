"""What a pipeline is going to do: its quality, its stages, and the monitor that follows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from mrgs.errors import MrgsError
from mrgs.method.config import DEFAULT_METHOD, TrainConfig, with_flat_field
from mrgs.pipeline.intake import Intake
from mrgs.prepare.contract import StageReport
from mrgs.prepare.options import PrepareOptions
from mrgs.run_files.folder import RunConfig
from mrgs.run_files.record import StepStatistics
from mrgs.runs.registry import find_method
from mrgs.scene import Scene


@dataclass(frozen=True)
class Quality:
    """How much work a pipeline puts into a model: the options of ``mrgs train``."""

    name: str
    preset: str
    max_steps: int
    max_gaussians: int
    resolution: int
    flat_field: Path | None = None
    flat_field_unit: str | None = None

    def config(self) -> TrainConfig:
        """The configuration of the training. ConfigError if the flat field is not a folder."""
        config: TrainConfig = find_method(DEFAULT_METHOD).configure(
            self.preset,
            max_steps=self.max_steps,
            max_gaussians=self.max_gaussians,
            resolution=self.resolution,
        )
        if self.flat_field is None:
            return config
        return with_flat_field(config, self.flat_field, self.flat_field_unit)


QUALITIES: dict[str, Quality] = {
    each.name: each
    for each in (
        Quality("fast", "fast", 1_500, 20_000, 640),
        Quality("default", "default", 4_000, 50_000, 1_024),
        Quality("best", "default", 8_000, 100_000, 1_600),
    )
}


@dataclass(frozen=True)
class PlannedStage:
    """A stage of a pipeline, with its number from 1, of ``total``, the seconds that its parts are
    expected to take, by name, and whether an earlier call has finished it, with the same inputs and
    settings."""

    name: str
    number: int
    total: int
    parts: Mapping[str, float]
    is_done: bool

    @property
    def seconds(self) -> float:
        """Expected duration; 0 if it is done."""
        return 0.0 if self.is_done else sum(self.parts.values())


@dataclass(frozen=True)
class PipelinePlan:
    """What a pipeline is going to do.

    Attributes:
        free_memory: bytes; None if not known.
        device: what trains and renders, such as "cpu" or a GPU's name.
        memory: bytes that are needed at most, roughly.
        disk: bytes that the results need, roughly.
        notes: sentences for the user.
    """

    intake: Intake
    quality: Quality
    cores: int
    free_memory: int | None
    device: str
    output: Path
    stages: tuple[PlannedStage, ...]
    memory: int
    disk: int
    notes: tuple[str, ...] = ()

    @property
    def seconds(self) -> float:
        """Expected duration of all stages."""
        return sum(stage.seconds for stage in self.stages)


class Monitor:
    """Follows a pipeline. This one shows nothing and accepts nothing; override its methods."""

    def planned(self, plan: PipelinePlan) -> None:
        """Called once, before the first stage."""

    def reused(self, stage: PlannedStage) -> None:
        """Called instead of ``running`` for a stage that an earlier call has finished."""

    def running(self, stage: PlannedStage, rest_s: float) -> AbstractContextManager[None]:
        """A context in which a stage runs."""
        return nullcontext()

    def progress(self, part: str, done: int, total: int, left_s: float | None) -> None:
        """Called while the photos are inspected, and while a stage runs: the finished items of a
        part, all of its items, 0 if not known, and the seconds until the stage is finished, None if
        not known."""

    def prepared(self, report: StageReport) -> None:
        """Called with the result of each part of the first stage."""

    def training_started(self, scene: Scene, config: RunConfig) -> None:
        """Called before the first training step."""

    def stepped(self, statistics: StepStatistics) -> bool | None:
        """Called after each training step; returning True stops the pipeline with a checkpoint."""
        return None

    def accepts(self, warnings: Sequence[str], page: Path) -> bool:
        """Whether to continue in spite of warnings about the scene, which ``page`` shows."""
        return False

    def accepts_relative(self, reason: MrgsError) -> bool:
        """Whether to continue with thermal photos without temperatures; called before anything is
        computed, with the reason and the remedy, whose ``options`` names what would help."""
        return False

    def answer(self, error: MrgsError, options: PrepareOptions) -> PrepareOptions | None:
        """The options with the information that ``error.options`` names; None to give up."""
        return None
