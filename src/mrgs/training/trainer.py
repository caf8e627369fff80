"""The training loop."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import TypeVar

import torch

from mrgs.data import load_scene
from mrgs.errors import SceneError, TrainingError
from mrgs.field import RadianceField
from mrgs.method.camera_model.image_model import Capture, ImageModel
from mrgs.method.config import TrainConfig
from mrgs.method.losses.radiation import DepthUncertainty
from mrgs.method.losses.terms import Photos, SceneScale
from mrgs.method.start.initialisation import initial_gaussians
from mrgs.method.start.start_points import start_points
from mrgs.render import Model, Photograph
from mrgs.scene import PosedImage, Scene, View
from mrgs.system import gpu
from mrgs.system.gpu import HOST, DeviceName
from mrgs.system.operation import plainly
from mrgs.training import checkpoint
from mrgs.training.checkpoint import CheckpointFacts
from mrgs.training.device_photos import DevicePhotos
from mrgs.training.driver import Driver
from mrgs.training.kernel_check import check_kernels
from mrgs.training.run_folder import RunFolder
from mrgs.training.step import (
    StepStatistics,
    TrainingState,
    changes_density,
    control_density,
    explore_means,
    training_step,
)
from mrgs.training.views import PhotoCache, PhotoSource

Result = TypeVar("Result")

OnStep = Callable[[StepStatistics], bool | None]
"""Called after every step; returning True stops the training with a checkpoint."""


def train(
    scene: str | Path,
    output: str | Path,
    config: TrainConfig,
    *,
    resume: bool = False,
    device: DeviceName = "auto",
    plain: bool = False,
    stop_at: int | None = None,
    on_step: OnStep | None = None,
    on_start: Callable[[Scene, TrainConfig], None] | None = None,
    on_model: Callable[[Model, Photograph], None] | None = None,
) -> RunFolder:
    """Train a model of a scene folder into a run folder.

    Args:
        scene: the scene's folder.
        output: the run's folder; must not hold a run unless ``resume``.
        config: what to train; a resumed run keeps its own.
        resume: continue the run from its newest checkpoint, exactly; on another device up to
            rounding.
        device: "auto" takes the GPU where there is one that can be used.
        plain: run the plain definitions of all operations instead of kernels, much slower; so does
            the environment variable MRGS_PLAIN=1.
        stop_at: leave after this step with a checkpoint, without changing the schedule.
        on_step: called after every step; returning True stops with a checkpoint.
        on_start: called once before the first step with the scene and the configuration in force.
        on_model: called after it with the model that is trained, which ``on_step`` may look at and
            must not change, and with what the scene's cameras are taken to do to its renderings, as
            far as is learned by then.

    Warns:
        MrgsWarning: a kernel differs from the plain definition of its operation, which is then used
            in its place.

    Raises:
        SceneError: the scene cannot be used.
        RunError: the output folder cannot be used.
        DeviceError: the GPU was asked for and cannot be used.
        TrainingError: three steps in a row gave values that are not finite (on a GPU this is found
            up to ten steps later), or the GPU's memory does not suffice; the last good checkpoint
            is kept.
    """
    chosen = gpu.choose_device(device)
    folder = RunFolder(output)
    if resume:
        folder.newest_checkpoint()
        config = folder.read_config()
    else:
        folder.require_new()
    loaded = load_scene(scene, resolution=config.resolution, seed=config.seed)
    with folder.locked(), plainly(plain):
        if not resume:
            folder.start(config)
        try:
            trainer = _Trainer(folder, loaded, str(Path(scene).resolve()), config, resume, chosen)
            if on_start is not None:
                on_start(loaded, config)
            if on_model is not None:
                on_model(trainer.model, _photograph_with(trainer.image_model, chosen))
            trainer.check_kernels()
            trainer.run(stop_at, on_step)
        except (
            SceneError,
            KeyboardInterrupt,
        ):  # a photo that cannot be decoded is found when its turn comes
            if not folder.checkpoints():
                folder.discard()
            raise
    return folder


def initial_state(scene: Scene, config: TrainConfig, device: torch.device = HOST) -> TrainingState:
    """The state at step 0; every random choice follows from the seed, and torch's own generators
    are left alone.

    It is made on the CPU, and so the same whatever the device.
    """
    capture = Capture.of(scene)
    # Without photos a modality's opacities never move, and max(o_c, o_t) would keep every Gaussian
    # from being pruned.
    shares_opacity = config.shares_opacity or not (scene.has_rgb and scene.has_thermal)
    generator = torch.Generator().manual_seed(config.seed)
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(config.seed)
        field = RadianceField(config.field)
        uncertainty = DepthUncertainty()
        field.set_frame(scene.points.positions)
        gaussians = initial_gaussians(
            start_points(scene, config),
            field,
            shares_opacity,
            config.temperature_sh_degree_of(capture),
            config.densification.max_gaussians,
            generator,
        )
    model = Model(
        gaussians,
        field,
        neighbours=None,
        sh_degree=0,
    )
    return checkpoint.make_state(model.to(device), uncertainty, config, capture, generator)


def _photograph_with(image_model: ImageModel, device: torch.device) -> Photograph:
    """Turns a rendering in the host's memory into what the cameras write, as far as is learned when
    it is called."""
    if device == HOST:
        return image_model.expected
    return lambda rendering, camera: deepcopy(image_model).to(HOST).expected(rendering, camera)


def _images(view: View) -> list[PosedImage]:
    return [image for image in (view.rgb, view.thermal) if image is not None]


class _Trainer(Driver[StepStatistics]):
    """Trains Gaussians."""

    def __init__(
        self,
        folder: RunFolder,
        scene: Scene,
        scene_path: str,
        config: TrainConfig,
        resume: bool,
        device: torch.device,
    ) -> None:
        facts = CheckpointFacts(0, scene_path, Capture.of(scene), scene.temperature, 0.0, 0, 0)
        if resume:
            newest = folder.newest_checkpoint()
            found = checkpoint.load_facts(newest)
            checkpoint.require_same_scene(found, scene)
            self._state = checkpoint.load_state(newest, config, device)
            facts = found._replace(scene=scene_path, capture=facts.capture)
            folder.cut_log(found.step)
        else:
            self._state = initial_state(scene, config, device)
        self._scene = scene
        self._config = config
        self._scale = SceneScale(scene.extent, scene.temperature)
        self._photos: PhotoSource = PhotoCache() if device.type == "cpu" else DevicePhotos(device)
        super().__init__(folder, facts, config.max_steps, config.checkpoint_every, device)

    @property
    def model(self) -> Model:
        """The model that is trained; the same object from the first step to the last."""
        return self._state.model

    @property
    def image_model(self) -> ImageModel:
        """What the scene's cameras do to the images; the same object too."""
        return self._state.image_model

    def check_kernels(self) -> None:
        """Compare the kernels in use with their plain definitions; the training stays the same."""
        check_kernels(self._state, self._scene.train, self._config, self._scale)

    def _take_step(self) -> StepStatistics:
        statistics = self._with_enough_memory(self._step_on_next_view)
        self._with_enough_memory(self._explore)
        self._fetch_next_view()
        if changes_density(self._config, statistics.step) and not statistics.skipped:
            self._with_enough_memory(self._control_density)
        return statistics

    def _step_on_next_view(self) -> StepStatistics:
        state = self._state
        number = state.sampler.next()
        view = self._scene.train[number]
        rgb, thermal = (
            None if image is None else self._photos.load(image)
            for image in (view.rgb, view.thermal)
        )
        photos = Photos(rgb, thermal, view.shares_camera)
        return training_step(state, view, number, photos, self._config, self._scale)

    def _explore(self) -> None:
        explore_means(self._state, self._config, self._scale.extent)

    def _fetch_next_view(self) -> None:
        """Let its photos come ahead of their turn, if there is memory for them."""
        following = self._state.sampler.peek()
        if following is None:
            return
        try:
            self._photos.fetch(_images(self._scene.train[following]))
        except torch.cuda.OutOfMemoryError:
            self._photos.release()

    def _with_enough_memory(self, action: Callable[[], Result]) -> Result:
        """Do something; once more, should a GPU's memory be full, with all given back that torch
        holds in reserve.

        An action changes the model when it has all the memory that it needs, so that to repeat it
        does nothing twice. But for one case: Adam makes its moments at the first step, one
        parameter after another.

        Raises:
            TrainingError: it is full again; the state before the action is left as a checkpoint.
        """
        state = self._state
        before = (state.step, state.generator.get_state(), state.sampler.state())
        for _ in range(2):
            try:
                return action()
            except torch.cuda.OutOfMemoryError:
                pass  # what the action has made is freed when this block is left
            state.go_back(*before)
            self._photos.release()
            torch.cuda.empty_cache()
        raise self._out_of_memory()

    def _out_of_memory(self) -> TrainingError:
        """Leaves a checkpoint of the last good step."""
        state = self._state
        self._step_done = state.step
        if state.step > 0:
            self._save()
        found = self._folder.checkpoints()
        kept = (
            f"the last good step is kept in {found[-1]}" if found else "there is no checkpoint yet"
        )
        go_on = "go on with --resume --device cpu, or train anew" if found else "train anew"
        return TrainingError(
            f"the GPU's memory does not suffice for step {state.step + 1:,} with "
            f"{len(state.model.gaussians):,} "
            f"Gaussians; {kept}: {go_on} with a smaller --max-gaussians or --resolution"
        )

    def _control_density(self) -> None:
        state = self._state
        counts = control_density(state, self._config, self._scale.extent)
        if counts is not None:
            self._folder.append_log(
                {"step": state.step, **counts._asdict(), "gaussians": len(state.model.gaussians)}
            )
        if len(state.model.gaussians) == 0:
            raise TrainingError(
                f"every Gaussian has turned transparent by step {state.step}: check the scene's "
                f"poses and images"
            )

    @property
    def _skipped_in_a_row(self) -> int:
        return int(self._state.skipped_in_a_row)

    def _write_checkpoint(self, path: Path, facts: CheckpointFacts) -> None:
        checkpoint.save(path, self._state, facts)
