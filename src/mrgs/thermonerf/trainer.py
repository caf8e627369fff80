"""The training loop."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from mrgs.data import load_scene
from mrgs.errors import SceneError, TrainingError
from mrgs.scene import Scene
from mrgs.thermonerf import checkpoint, run_files
from mrgs.thermonerf.config import ThermoNerfConfig
from mrgs.thermonerf.pixels import PixelPool
from mrgs.thermonerf.step import ThermoNerfStatistics, initial_state, training_step
from mrgs.training.checkpoint import CheckpointFacts, require_same_scene
from mrgs.training.image_model import Capture
from mrgs.training.memory import peak_memory_bytes
from mrgs.training.run_folder import RunFolder
from mrgs.training.trainer import LOG_EVERY, MAX_SKIPPED_IN_A_ROW

OnStep = Callable[[ThermoNerfStatistics], bool | None]
"""Called after every step; returning True stops the training with a checkpoint."""


def train_thermonerf(
    scene: str | Path,
    output: str | Path,
    config: ThermoNerfConfig,
    *,
    resume: bool = False,
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
        stop_at: leave after this step with a checkpoint, without changing the schedule.
        on_step: called after every step; returning True stops with a checkpoint.
        on_start: called once before the first step with the scene and the configuration in force.

    Raises:
        SceneError: the scene cannot be used.
        RunError: the output folder cannot be used.
        TrainingError: three steps in a row gave values that are not finite; the last good checkpoint is kept.
    """
    folder = RunFolder(output)
    if resume:
        folder.newest_checkpoint()
        config = run_files.read_config(folder)
    else:
        run_files.require_new(folder)
    loaded = load_scene(scene, resolution=config.resolution, seed=config.seed)
    with folder.locked():
        if not resume:
            run_files.start(folder, config)
        try:
            trainer = _Trainer(folder, loaded, str(Path(scene).resolve()), config, resume)
            if on_start is not None:
                on_start(loaded, config)
            trainer.run(stop_at, on_step)
        except (SceneError, KeyboardInterrupt):
            if not folder.checkpoints():
                folder.discard()
            raise
    return folder


class _Trainer:
    """Drives a state through its steps, and keeps the run's folder up to date."""

    def __init__(
        self, folder: RunFolder, scene: Scene, scene_path: str, config: ThermoNerfConfig, resume: bool
    ) -> None:
        self._folder = folder
        self._scene = scene
        self._config = config
        if resume:
            self._state, self._facts = checkpoint.load_state(folder.newest_checkpoint(), config)
            require_same_scene(self._facts, scene)
            folder.cut_log(self._facts.step)
        else:
            self._state = initial_state(scene, config)
            self._facts = CheckpointFacts(0, scene_path, Capture.of(scene), scene.temperature, 0.0, 0, 0)
        self._pool = PixelPool(scene, self._state.model.frame)
        self._skipped_steps = self._facts.skipped_steps
        self._started = time.perf_counter()

    def run(self, stop_at: int | None, on_step: OnStep | None) -> None:
        """Step until the end of the schedule, or until somebody asks to stop; the last step is checkpointed."""
        last = self._config.max_steps if stop_at is None else min(stop_at, self._config.max_steps)
        while self._state.step < last:
            statistics = training_step(self._state, self._pool, self._config)
            if statistics.skipped:
                self._note_skipped(statistics)
            if statistics.step % LOG_EVERY == 0 or statistics.step == self._config.max_steps:
                self._log(statistics)
            if on_step is not None and on_step(statistics) is True:
                last = self._state.step
            if self._state.step % self._config.checkpoint_every == 0 or self._state.step == last:
                self._save()

    def _note_skipped(self, statistics: ThermoNerfStatistics) -> None:
        self._skipped_steps += 1
        self._folder.append_log({"step": statistics.step, "skipped": "the loss or a gradient was not finite"})
        if self._state.skipped_in_a_row >= MAX_SKIPPED_IN_A_ROW:
            found = self._folder.checkpoints()
            kept = f"the last good checkpoint is {found[-1]}" if found else "there is no checkpoint yet"
            again = "Resume" if found else "Train anew"
            raise TrainingError(
                f"{MAX_SKIPPED_IN_A_ROW} steps in a row gave values that are not finite, at step {statistics.step}; "
                f"{kept}. {again} with a smaller learning rate, or check the scene's poses and images"
            )

    def _log(self, statistics: ThermoNerfStatistics) -> None:
        entry: dict[str, float | None] = {"step": statistics.step}
        if not statistics.skipped:
            temperature, error = self._scene.temperature, statistics.thermal_error
            entry["loss"] = statistics.loss
            entry |= {f"loss_{name}": value for name, value in statistics.terms.items()}
            entry["thermal_error_c"] = None if error is None or temperature is None else error * temperature.span_c
        self._folder.append_log({**entry, "seconds": self._seconds()})

    def _seconds(self) -> float:
        return self._facts.train_seconds + time.perf_counter() - self._started

    def _save(self) -> None:
        facts = self._facts._replace(
            step=self._state.step,
            train_seconds=self._seconds(),
            peak_memory_bytes=max(self._facts.peak_memory_bytes, peak_memory_bytes()),
            skipped_steps=self._skipped_steps,
        )
        checkpoint.save(self._folder.checkpoint_file(self._state.step), self._state, facts)
        self._folder.drop_old_checkpoints()
