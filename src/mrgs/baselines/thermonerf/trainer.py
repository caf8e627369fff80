"""The training loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import Tensor

from mrgs.baselines.thermonerf import checkpoint
from mrgs.baselines.thermonerf.config import METHOD, ThermoNerfConfig, from_yaml
from mrgs.baselines.thermonerf.model import ALL_ROWS
from mrgs.baselines.thermonerf.pixels import MODALITIES, PixelPool
from mrgs.baselines.thermonerf.run import require_cpu
from mrgs.baselines.thermonerf.step import (
    NerfState,
    ThermoNerfStatistics,
    initial_state,
    training_step,
)
from mrgs.errors import RunError
from mrgs.scene import Scene
from mrgs.system.gpu import DeviceName
from mrgs.system.operation import checking
from mrgs.training.driver import Driver
from mrgs.training.facts import CheckpointFacts
from mrgs.training.run_folder import RunFolder
from mrgs.training.start import TrainingStart, start_training

CHECKED_RAYS = 32
"""Rays on which the kernels are compared with their plain definitions."""

OnStep = Callable[[ThermoNerfStatistics], bool | None]
"""Called after every step; returning True stops the training with a checkpoint."""


def train_thermonerf(
    scene: Scene | str | Path,
    output: str | Path,
    config: ThermoNerfConfig,
    *,
    resume: bool = False,
    accept_changes: bool = False,
    device: DeviceName = "auto",
    plain: bool = False,
    tensorboard: bool = False,
    stop_at: int | None = None,
    on_step: OnStep | None = None,
    on_start: Callable[[Scene, ThermoNerfConfig], None] | None = None,
) -> RunFolder:
    """Train a ThermoNeRF of a scene folder into a run folder.

    Args:
        scene: the scene or its folder.
        output: the run's folder; must not hold a run unless ``resume``.
        config: what to train; a resumed run keeps its own.
        resume: continue the run from its newest checkpoint that is whole, exactly.
        accept_changes: resume where photos, poses or intrinsics have changed since the run began.
        device: "auto" or "cpu".
        plain: run the plain definitions of all operations instead of kernels, much slower.
        tensorboard: also write the log to the run's folder ``tensorboard``.
        stop_at: leave after this step with a checkpoint, without changing the schedule.
        on_step: called after every step; returning True stops with a checkpoint.
        on_start: called once, before the model is made, with the scene and the configuration in
            force.

    Warns:
        MrgsWarning: a kernel differs from the plain definition of its operation, which is then used
            in its place; the newest checkpoint is damaged and an older one is used; or changes of
            the scene are accepted.

    Raises:
        SceneError: the scene cannot be used.
        RunError: the output folder cannot be used, or the scene has changed since the run began.
        DeviceError: the GPU was asked for.
        TrainingError: three steps in a row gave values that are not finite, or the model holds
            such a value; the last good checkpoint is kept.
    """
    require_cpu(device)
    with start_training(
        scene,
        output,
        config,
        resume=resume,
        accept_changes=accept_changes,
        plain=plain,
        tensorboard=tensorboard,
        on_start=on_start,
        read_config=_config_of,
        initial_state=initial_state,
        load_state=checkpoint.load_state,
    ) as run:
        trainer = _Trainer(run)
        trainer.check_kernels()
        trainer.run(stop_at, on_step)
    return run.folder


def _config_of(folder: RunFolder) -> ThermoNerfConfig:
    if folder.method != METHOD:
        raise RunError(f"{folder.path} is a run of {folder.method}, not of {METHOD}")
    return folder.read_config(from_yaml)


class _Trainer(Driver[ThermoNerfStatistics]):
    """Trains a radiance field."""

    def __init__(self, run: TrainingStart[ThermoNerfConfig, NerfState]) -> None:
        self._config, self._state = run.config, run.state
        self._pool = PixelPool(run.scene, run.state.model.frame)
        super().__init__(run.folder, run.facts, run.config.max_steps, run.config.checkpoint_every)

    def check_kernels(self) -> None:
        """Compare the kernels in use with their plain definitions; the training stays the same."""
        model = self._state.model
        generator = torch.Generator().manual_seed(0)
        batch = self._pool.draw(CHECKED_RAYS, generator)
        with checking():
            model.trace(batch.rays, dict.fromkeys(MODALITIES, ALL_ROWS), generator)

    def _take_step(self) -> ThermoNerfStatistics:
        return training_step(self._state, self._pool, self._config)

    @property
    def _skipped_in_a_row(self) -> int:
        return self._state.skipped_in_a_row

    def _tensors(self) -> Mapping[str, Tensor]:
        return checkpoint.tensors_of(self._state)

    def _write_checkpoint(self, path: Path, facts: CheckpointFacts) -> None:
        checkpoint.save(path, self._state, facts)
