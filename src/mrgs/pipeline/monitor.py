"""What a pipeline reports, and what it asks."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from mrgs.errors import MrgsError
from mrgs.pipeline.plan import PipelinePlan, PlannedStage
from mrgs.prepare.contract import StageReport
from mrgs.prepare.options import PrepareOptions
from mrgs.scene import Scene
from mrgs.training.driver import Statistics
from mrgs.training.run_folder import RunConfig


class Monitor:
    """Follows a pipeline. Here nothing is shown, and nothing is accepted; override what you want
    to."""

    def planned(self, plan: PipelinePlan) -> None:
        """Called once, before the first stage."""

    def reused(self, stage: PlannedStage) -> None:
        """Called instead of ``running`` for a stage that an earlier call has finished."""

    def running(self, stage: PlannedStage, rest_s: float) -> AbstractContextManager[None]:
        """A context in which a stage runs.

        Args:
            stage: that begins.
            rest_s: seconds that the stages after it are expected to take.
        """
        return nullcontext()

    def progress(self, part: str, done: int, total: int, left_s: float | None) -> None:
        """Called while the photos are looked at, and while a stage runs.

        Args:
            part: of the stage.
            done: how much of the part is done.
            total: of how much; 0 if that is not known.
            left_s: seconds until the stage is finished; None if not known.
        """

    def prepared(self, report: StageReport) -> None:
        """Called with the result of each part of the first stage."""

    def training_started(self, scene: Scene, config: RunConfig) -> None:
        """Called before the first training step."""

    def stepped(self, statistics: Statistics) -> bool | None:
        """Called after each training step; returning True stops the pipeline with a checkpoint."""
        return None

    def accepts(self, warnings: Sequence[str], page: Path) -> bool:
        """Whether to go on in spite of warnings about the scene.

        Args:
            warnings: one sentence each.
            page: shows the scene.
        """
        return False

    def accepts_relative(self, reason: MrgsError) -> bool:
        """Whether to go on with thermal photos that hold no temperatures; asked before anything is
        computed.

        Args:
            reason: why they hold none, and the remedy; ``options`` names what would help.
        """
        return False

    def answer(self, error: MrgsError, options: PrepareOptions) -> PrepareOptions | None:
        """The options completed by what the photos do not say, where ``error.options`` names it;
        None to give up."""
        return None
