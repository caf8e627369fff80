"""The training loop."""

from __future__ import annotations

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
from mrgs.training.driver import Driver
from mrgs.training.image_model import Capture
from mrgs.training.initialisation import initial_gaussians
from mrgs.training.radiation import DepthUncertainty
from mrgs.training.run_folder import RunFolder
from mrgs.training.start_points import start_points
from mrgs.training.step import StepStatistics, TrainingState, control_density, training_step
from mrgs.training.terms import Photos, SceneScale
from mrgs.training.views import PhotoCache

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
        field.set_frame(scene.points.positions)
        gaussians = initial_gaussians(
            start_points(scene, config),
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
        antialiased=config.antialiased,
    )
    return checkpoint.make_state(model, uncertainty, config, Capture.of(scene), generator)


class _Trainer(Driver[StepStatistics]):
    """Trains Gaussians."""

    def __init__(self, folder: RunFolder, scene: Scene, scene_path: str, config: TrainConfig, resume: bool) -> None:
        facts = CheckpointFacts(0, scene_path, Capture.of(scene), scene.temperature, 0.0, 0, 0)
        if resume:
            newest = folder.newest_checkpoint()
            found = checkpoint.load_facts(newest)
            checkpoint.require_same_scene(found, scene)
            self._state = checkpoint.load_state(newest, config)
            facts = found._replace(scene=scene_path, capture=facts.capture)
            folder.cut_log(found.step)
        else:
            self._state = initial_state(scene, config)
        self._scene = scene
        self._config = config
        self._scale = SceneScale(scene.extent, scene.temperature)
        self._photos = PhotoCache()
        super().__init__(folder, facts, config.max_steps, config.checkpoint_every)

    @property
    def model(self) -> Model:
        """The model that is trained; the same object from the first step to the last."""
        return self._state.model

    def _take_step(self) -> StepStatistics:
        state = self._state
        number = state.sampler.next()
        view = self._scene.train[number]
        photos = Photos(self._photos.load(view.rgb), self._photos.load(view.thermal), view.shares_camera)
        statistics = training_step(state, view, number, photos, self._config, self._scale)
        if not statistics.skipped:
            self._control_density()
        return statistics

    def _control_density(self) -> None:
        state = self._state
        counts = control_density(state, self._config, self._scale.extent)
        if counts is not None:
            self._folder.append_log({"step": state.step, **counts._asdict(), "gaussians": len(state.model.gaussians)})
        if len(state.model.gaussians) == 0:
            raise TrainingError(
                f"every Gaussian has turned transparent by step {state.step}: check the scene's poses and images"
            )

    @property
    def _skipped_in_a_row(self) -> int:
        return self._state.skipped_in_a_row

    def _write_checkpoint(self, path: Path, facts: CheckpointFacts) -> None:
        checkpoint.save(path, self._state, facts)
