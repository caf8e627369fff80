"""The training loop."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch

from mrgs.baselines.thermonerf import checkpoint, run_files
from mrgs.baselines.thermonerf.config import ThermoNerfConfig
from mrgs.baselines.thermonerf.model import ALL_ROWS
from mrgs.baselines.thermonerf.pixels import PixelPool
from mrgs.baselines.thermonerf.step import ThermoNerfStatistics, initial_state, training_step
from mrgs.data import load_scene
from mrgs.errors import SceneError
from mrgs.method.camera_model.image_model import Capture
from mrgs.scene import Scene
from mrgs.system.operation import checking, plainly
from mrgs.training.checkpoint import CheckpointFacts, require_same_scene
from mrgs.training.driver import Driver
from mrgs.training.run_folder import RunFolder

CHECKED_RAYS = 32
"""Rays on which the kernels are compared with their plain definitions."""

OnStep = Callable[[ThermoNerfStatistics], bool | None]
"""Called after every step; returning True stops the training with a checkpoint."""


def train_thermonerf(
    scene: str | Path,
    output: str | Path,
    config: ThermoNerfConfig,
    *,
    resume: bool = False,
    plain: bool = False,
    stop_at: int | None = None,
    on_step: OnStep | None = None,
    on_start: Callable[[Scene, ThermoNerfConfig], None] | None = None,
) -> RunFolder:
    """Train a ThermoNeRF of a scene folder into a run folder.

    Args:
        scene: the scene's folder.
        output: the run's folder; must not hold a run unless ``resume``.
        config: what to train; a resumed run keeps its own.
        resume: continue the run from its newest checkpoint, exactly.
        plain: run the plain definitions of all operations instead of kernels, much slower.
        stop_at: leave after this step with a checkpoint, without changing the schedule.
        on_step: called after every step; returning True stops with a checkpoint.
        on_start: called once before the first step with the scene and the configuration in force.

    Warns:
        MrgsWarning: a kernel differs from the plain definition of its operation, which is then used
            in its place.

    Raises:
        SceneError: the scene cannot be used.
        RunError: the output folder cannot be used.
        TrainingError: three steps in a row gave values that are not finite; the last good
            checkpoint is kept.
    """
    folder = RunFolder(output)
    if resume:
        folder.newest_checkpoint()
        config = run_files.read_config(folder)
    else:
        run_files.require_new(folder)
    loaded = load_scene(scene, resolution=config.resolution, seed=config.seed)
    with folder.locked(), plainly(plain):
        if not resume:
            run_files.start(folder, config)
        try:
            trainer = _Trainer(folder, loaded, str(Path(scene).resolve()), config, resume)
            if on_start is not None:
                on_start(loaded, config)
            trainer.check_kernels()
            trainer.run(stop_at, on_step)
        except (SceneError, KeyboardInterrupt):
            if not folder.checkpoints():
                folder.discard()
            raise
    return folder


class _Trainer(Driver[ThermoNerfStatistics]):
    """Trains a radiance field."""

    def __init__(
        self,
        folder: RunFolder,
        scene: Scene,
        scene_path: str,
        config: ThermoNerfConfig,
        resume: bool,
    ) -> None:
        if resume:
            self._state, facts = checkpoint.load_state(folder.newest_checkpoint(), config)
            require_same_scene(facts, scene)
            folder.cut_log(facts.step)
        else:
            self._state = initial_state(scene, config)
            facts = CheckpointFacts(0, scene_path, Capture.of(scene), scene.temperature, 0.0, 0, 0)
        self._config = config
        self._pool = PixelPool(scene, self._state.model.frame)
        super().__init__(folder, facts, config.max_steps, config.checkpoint_every)

    def check_kernels(self) -> None:
        """Compare the kernels in use with their plain definitions; the training stays the same."""
        model = self._state.model
        generator = torch.Generator().manual_seed(0)
        batch = self._pool.draw(CHECKED_RAYS, generator)
        with checking():
            model.trace(batch.rays, ALL_ROWS, ALL_ROWS, generator)

    def _take_step(self) -> ThermoNerfStatistics:
        return training_step(self._state, self._pool, self._config)

    @property
    def _skipped_in_a_row(self) -> int:
        return self._state.skipped_in_a_row

    def _write_checkpoint(self, path: Path, facts: CheckpointFacts) -> None:
        checkpoint.save(path, self._state, facts)
