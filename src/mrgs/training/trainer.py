"""The training loop."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import torch

from mrgs.data import load_scene
from mrgs.errors import SceneError, TrainingError
from mrgs.field import RadianceField
from mrgs.render import Model
from mrgs.scene import Scene
from mrgs.training import checkpoint
from mrgs.training.checkpoint import CheckpointFacts
from mrgs.training.config import TrainConfig
from mrgs.training.image_model import Capture
from mrgs.training.initialisation import initial_gaussians
from mrgs.training.memory import peak_memory_bytes
from mrgs.training.radiation import DepthUncertainty
from mrgs.training.run_folder import RunFolder
from mrgs.training.step import StepStatistics, TrainingState, control_density, training_step
from mrgs.training.terms import Photos, SceneScale
from mrgs.training.views import PhotoCache

LOG_EVERY = 10
MAX_SKIPPED_IN_A_ROW = 3

OnStep = Callable[[StepStatistics], bool | None]
"""Called after every step; returning True stops the training with a checkpoint."""


def train(
    scene: str | Path,
    output: str | Path,
    config: TrainConfig,
    *,
    resume: bool = False,
    stop_at: int | None = None,
    on_step: OnStep | None = None,
    on_start: Callable[[Scene, TrainConfig], None] | None = None,
    on_model: Callable[[Model], None] | None = None,
) -> RunFolder:
    """Train a model of a scene folder into a run folder.

    Args:
        scene: the scene's folder.
        output: the run's folder; must not hold a run unless ``resume``.
        config: what to train; a resumed run keeps its own.
        resume: continue the run from its newest checkpoint, exactly.
        stop_at: leave after this step with a checkpoint, without changing the schedule.
        on_step: called after every step; returning True stops with a checkpoint.
        on_start: called once before the first step with the scene and the configuration in force.
        on_model: called after it with the model that is trained, which ``on_step`` may look at and must not change.

    Raises:
        SceneError: the scene cannot be used.
        RunError: the output folder cannot be used.
        TrainingError: three steps in a row gave values that are not finite; the last good checkpoint is kept.
    """
    folder = RunFolder(output)
    if resume:
        folder.newest_checkpoint()
        config = folder.read_config()
    else:
        folder.require_new()
    loaded = load_scene(scene, resolution=config.resolution, seed=config.seed)
    with folder.locked():
        if not resume:
            folder.start(config)
        try:
            trainer = _Trainer(folder, loaded, str(Path(scene).resolve()), config, resume)
            if on_start is not None:
                on_start(loaded, config)
            if on_model is not None:
                on_model(trainer.model)
            trainer.run(stop_at, on_step)
        except (SceneError, KeyboardInterrupt):  # a photo that cannot be decoded is found when its turn comes
            if not folder.checkpoints():
                folder.discard()
            raise
    return folder


def initial_state(scene: Scene, config: TrainConfig) -> TrainingState:
    """The state at step 0; every random choice follows from the seed, and torch's own generator is left alone."""
    # Without photos a modality's opacities never move, and max(o_c, o_t) would keep every Gaussian from being pruned.
    shares_opacity = config.shares_opacity or not (scene.has_rgb and scene.has_thermal)
    generator = torch.Generator().manual_seed(config.seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        field = RadianceField(config.field)
        uncertainty = DepthUncertainty()
        gaussians = initial_gaussians(
            scene.points,
            field,
            shares_opacity,
            config.temperature_degree,
            config.densification.max_gaussians,
            generator,
        )
    model = Model(
        gaussians,
        field,
        neighbours=None,
        sh_degree=0,
        background_rgb=config.background_rgb,
        background_thermal=config.background_thermal,
    )
    return checkpoint.make_state(model, uncertainty, config, Capture.of(scene), generator)


class _Trainer:
    """Drives a state through its steps, and keeps the run's folder up to date."""

    def __init__(self, folder: RunFolder, scene: Scene, scene_path: str, config: TrainConfig, resume: bool) -> None:
        self._folder = folder
        self._scene = scene
        self._scene_path = scene_path
        self._config = config
        self._scale = SceneScale(scene.extent, scene.temperature)
        self._photos = PhotoCache()
        self._skipped_steps = 0
        self._seconds_before = 0.0
        self._peak_before = 0
        if resume:
            newest = folder.newest_checkpoint()
            facts = checkpoint.load_facts(newest)
            checkpoint.require_same_scene(facts, scene)
            self._state = checkpoint.load_state(newest, config)
            self._seconds_before, self._skipped_steps = facts.train_seconds, facts.skipped_steps
            self._peak_before = facts.peak_memory_bytes
            folder.cut_log(facts.step)
        else:
            self._state = initial_state(scene, config)
        self._started = time.perf_counter()

    @property
    def model(self) -> Model:
        """The model that is trained; the same object from the first step to the last."""
        return self._state.model

    def run(self, stop_at: int | None, on_step: OnStep | None) -> None:
        """Step until the end of the schedule, or until somebody asks to stop; the last step is checkpointed."""
        last = self._config.max_steps if stop_at is None else min(stop_at, self._config.max_steps)
        while self._state.step < last:
            statistics = self._step()
            asked_to_stop = on_step is not None and on_step(statistics) is True
            if asked_to_stop:
                last = self._state.step
            if self._state.step % self._config.checkpoint_every == 0 or self._state.step == last:
                self._save()

    def _step(self) -> StepStatistics:
        state = self._state
        number = state.sampler.next()
        view = self._scene.train[number]
        photos = Photos(self._photos.load(view.rgb), self._photos.load(view.thermal), view.shares_camera)
        statistics = training_step(state, view, number, photos, self._config, self._scale)
        if statistics.skipped:
            self._note_skipped(statistics)
        else:
            counts = control_density(state, self._config, self._scale.extent)
            if counts is not None:
                self._folder.append_log(
                    {"step": state.step, **counts._asdict(), "gaussians": len(state.model.gaussians)}
                )
            if len(state.model.gaussians) == 0:
                raise TrainingError(
                    f"every Gaussian has turned transparent by step {state.step}: check the scene's poses and images"
                )
        if state.step % LOG_EVERY == 0 or state.step == self._config.max_steps:
            self._log(statistics)
        return statistics

    def _note_skipped(self, statistics: StepStatistics) -> None:
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

    def _log(self, statistics: StepStatistics) -> None:
        temperature = self._scene.temperature
        error = statistics.thermal_error
        self._folder.append_log(
            {
                "step": statistics.step,
                "loss": statistics.loss,
                **{f"loss_{name}": value for name, value in statistics.terms.items()},
                "thermal_error_c": None if error is None or temperature is None else error * temperature.span_c,
                "gaussians": statistics.gaussians,
                "seconds": self._seconds(),
            }
            if not statistics.skipped
            else {"step": statistics.step, "gaussians": statistics.gaussians, "seconds": self._seconds()}
        )

    def _seconds(self) -> float:
        return self._seconds_before + time.perf_counter() - self._started

    def _save(self) -> None:
        facts = CheckpointFacts(
            step=self._state.step,
            scene=self._scene_path,
            capture=Capture.of(self._scene),
            temperature=self._scene.temperature,
            train_seconds=self._seconds(),
            peak_memory_bytes=max(self._peak_before, peak_memory_bytes()),
            skipped_steps=self._skipped_steps,
        )
        checkpoint.save(self._folder.checkpoint_file(self._state.step), self._state, facts)
        self._folder.drop_old_checkpoints()
