"""The training loop."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from copy import deepcopy
from pathlib import Path
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from mrgs.distributed.processes import Processes
from mrgs.errors import ConfigError, LinkError, PeerError, TrainingError
from mrgs.method.config import TrainConfig, from_yaml
from mrgs.method.density import Strategy
from mrgs.method.losses.term import SceneScale, Term
from mrgs.method.parts import part_spreads
from mrgs.rasterizer.near_plane import too_near
from mrgs.render import Model
from mrgs.scene import CameraResponse, Scene
from mrgs.system import gpu
from mrgs.system.callers import warn
from mrgs.system.gpu import HOST, DeviceName, lacks_memory
from mrgs.system.limits import whole_number
from mrgs.system.operation import is_plain
from mrgs.system.room import warn_if_short
from mrgs.system.torch_modes import own_modes
from mrgs.training import checkpoint
from mrgs.training.compilation import shared_compiling
from mrgs.training.device_photos import DevicePhotos
from mrgs.training.driver import Driver
from mrgs.training.facts import CheckpointFacts
from mrgs.training.gradient_exchange import GradientExchange
from mrgs.training.kernel_check import check_kernels
from mrgs.training.memory import checkpoint_bytes, retried_when_full
from mrgs.training.peers import Peers
from mrgs.training.photos import HostPhotos, PhotoSource, kept_limit
from mrgs.training.recorder import Recorder
from mrgs.training.replicas import align_replicas
from mrgs.training.run_folder import CHECKPOINTS_KEPT, RunFolder
from mrgs.training.start import TrainingStart, start_training
from mrgs.training.state import TrainingState, initial_state
from mrgs.training.step import (
    StepResult,
    StepStatistics,
    control_density,
    training_step,
)
from mrgs.training.view_pass import PhotographedView

Result = TypeVar("Result")

OnStep = Callable[[StepStatistics], object]
"""Called after every step; returning True stops the training with a checkpoint."""


class TrainingPart(NamedTuple):
    """A training of a part of a scene.

    Attributes:
        views: training views that take part, in ascending order.
        strategy: density control; it says which Gaussians move.
        start: the state at step 0, from the scene, the configuration and the device.
    """

    views: Sequence[int]
    strategy: Strategy
    start: Callable[[Scene, TrainConfig, torch.device], TrainingState]


@contextmanager
def open_training(
    scene: Scene | str | Path,
    output: str | Path,
    config: TrainConfig,
    *,
    resume: bool = False,
    accept_changes: bool = False,
    device: DeviceName = "auto",
    plain: bool = False,
    tensorboard: bool = False,
    strategy: Strategy | None = None,
    terms: Sequence[Term] = (),
    on_start: Callable[[Scene, TrainConfig], None] | None = None,
    processes: Processes | None = None,
    part: TrainingPart | None = None,
) -> Iterator[Trainer]:
    """Within this block the run's folder is locked, and a trainer is ready for its first step; see
    ``train``."""
    chosen = gpu.choose_device(device)
    strategy = strategy if part is None else part.strategy

    def at_start(loaded: Scene, own: TrainConfig) -> TrainingState:
        if part is not None:
            return part.start(loaded, own, chosen)
        return initial_state(loaded, own, chosen, strategy, terms)

    on_kernels = chosen == HOST and not (plain or is_plain())
    compiles = on_kernels and (processes is None or processes.launch.local_rank == 0)
    with (
        shared_compiling(config) if compiles else nullcontext(),
        start_training(
            scene,
            output,
            config,
            resume=resume,
            accept_changes=accept_changes,
            plain=plain,
            tensorboard=tensorboard,
            on_start=on_start,
            read_config=lambda folder: folder.read_config(from_yaml),
            initial_state=at_start,
            load_state=lambda path, own: checkpoint.load_state(path, own, chosen, strategy, terms),
            peers=None if processes is None else Peers(processes, chosen, strategy, terms),
        ) as run,
    ):
        _require_enough_views(run, len(run.scene.train) if part is None else len(part.views))
        if processes is None or processes.is_first:
            _check_room(run)
            _warn_if_too_near(run.scene)
        if part is not None:
            run.state.sampler.restrict(part.views)
        # A resumed run goes on with the cameras as they are now, in every process.
        run.state.model.dilation = run.config.dilation_of(run.facts.capture)
        with closing(Trainer(run, processes)) as trainer:
            yield trainer


def train(
    scene: Scene | str | Path,
    output: str | Path,
    config: TrainConfig,
    *,
    resume: bool = False,
    accept_changes: bool = False,
    device: DeviceName = "auto",
    plain: bool = False,
    tensorboard: bool = False,
    stop_at: int | None = None,
    strategy: Strategy | None = None,
    terms: Sequence[Term] = (),
    on_step: OnStep | None = None,
    on_start: Callable[[Scene, TrainConfig], None] | None = None,
    on_model: Callable[[Model, CameraResponse], None] | None = None,
    processes: Processes | None = None,
    part: TrainingPart | None = None,
) -> RunFolder:
    """Train a model of a scene into a run folder.

    Ctrl-C ends the training after the current step, and an error in ``on_step`` after the last one,
    with a checkpoint; a second Ctrl-C ends it at once.

    Args:
        scene: the scene or its folder; one that was read before keeps its resolution.
        output: the run's folder; must not hold a run unless ``resume``.
        config: what to train; a resumed run keeps its own.
        resume: continue the run from its newest checkpoint that is whole, exactly; on another
            device up to rounding.
        accept_changes: resume where photos, poses or intrinsics have changed since the run began.
        device: "auto" takes the GPU where there is one that can be used.
        plain: run the plain definitions of all operations instead of kernels, much slower; so does
            the environment variable MRGS_PLAIN=1.
        tensorboard: also write the log to the run's folder ``tensorboard``.
        stop_at: leave after this step with a checkpoint, without changing the schedule.
        strategy: density control instead of the configuration's; a resumed run needs it again.
        terms: of the loss, besides the configuration's; one with the name of such a term takes its
            place. A resumed run needs them again.
        on_step: called after every step; returning True stops with a checkpoint.
        on_start: called once, before the model is made, with the scene and the configuration in
            force.
        on_model: called after it with the model that is trained, which ``on_step`` may look at and
            must not change, and with what the scene's cameras are taken to do to its renderings, as
            far as is learned by then.
        processes: that train the run together; all of them call this with the same arguments, but
            for the hooks, and the first one alone writes into ``output``.
        part: of the scene to which the training is limited; a resumed run needs it again.

    Warns:
        MrgsWarning: a kernel differs from the plain definition of its operation, which is then used
            in its place; the newest checkpoint is damaged and an older one is used; changes of the
            scene are accepted; or much of the scene lies before the near plane.

    Raises:
        SceneError: the scene cannot be used.
        RunError: the output folder cannot be used, or the resumed run had another strategy, other
            terms, or other photos, poses or intrinsics.
        DeviceError: the GPU was asked for and cannot be used.
        ConfigError: a parameter is not what it should be, TensorBoard was asked for and is not
            installed, or there are more processes, or more views in a step, than there are views.
        TrainingError: three steps in a row gave values that are not finite (on a GPU this is found
            up to ten steps later), the model holds such a value (found up to a hundred steps
            later, and always before it is saved), or the GPU's memory does not suffice; the last
            good checkpoint is kept.
        LinkError, PeerError: another process is gone; the first one has saved a checkpoint.
    """
    if stop_at is not None and whole_number(stop_at, "stop_at") < 1:
        raise ConfigError(f"stop_at must be at least 1, not {stop_at}", options=("stop_at",))
    with open_training(
        scene,
        output,
        config,
        resume=resume,
        accept_changes=accept_changes,
        device=device,
        plain=plain,
        tensorboard=tensorboard,
        strategy=strategy,
        terms=terms,
        on_start=on_start,
        processes=processes,
        part=part,
    ) as trainer:
        if on_model is not None:
            on_model(trainer.state.model, _response_of(trainer.state))
        trainer.check_kernels()
        trainer.run(stop_at, on_step)
    return trainer.folder


def _check_room(run: TrainingStart[TrainConfig, TrainingState]) -> None:
    """Warn if the disk has too little room for the checkpoints: those that are kept, and the one
    that is being written."""
    most = max(run.config.densification.max_gaussians, len(run.state.model.gaussians))
    size = checkpoint_bytes(run.config, run.scene.modalities, most)
    warn_if_short(run.folder.path, (CHECKPOINTS_KEPT + 1) * size, "this run")


def _warn_if_too_near(scene: Scene) -> None:
    """Warn of a scene whose unit of length puts much of it before the near plane."""
    near = too_near(scene.train_cameras, scene.points.positions)
    if near is not None:
        warn(f"{scene.name}: {near.text} {near.remedy}")


def _require_enough_views(run: TrainingStart[TrainConfig, TrainingState], count: int) -> None:
    """Each view of a step is another one.

    Raises:
        ConfigError: a step has more views than the scene.
    """
    if run.config.batch > count:
        raise ConfigError(
            f"a batch of {run.config.batch} is more than the {count} training views "
            f"of {run.scene.name}: choose a smaller one",
            options=("batch",),
        )


def _response_of(state: TrainingState) -> CameraResponse:
    """Turns a rendering in the host's memory into what the cameras write, as far as is learned when
    it is called."""
    image_model = state.image_model
    if state.device == HOST:
        return image_model.expected
    return lambda *seen, **sizes: deepcopy(image_model).to(HOST).expected(*seen, **sizes)


class Trainer(Driver[StepStatistics]):
    """Trains Gaussians: choose views, take a step on them, control the density.

    Attributes:
        folder: of the run, locked.
        scene: that is trained on.
        config: in force.
        state: all that changes during training.
    """

    def __init__(
        self,
        run: TrainingStart[TrainConfig, TrainingState],
        processes: Processes | None = None,
    ) -> None:
        self.folder, self.scene, self.config, self.state = (
            run.folder,
            run.scene,
            run.config,
            run.state,
        )
        device = run.state.device
        self._processes = processes
        has_others = processes is not None and processes.count > 1
        batch = run.config.batch
        self._share = _share_of(batch, processes)
        self._exchange = (
            GradientExchange(processes, batch, self._share) if processes and has_others else None
        )
        self._scale = SceneScale.of(run.scene)
        self._recorder = Recorder(device) if device.type == "cuda" and not is_plain() else None
        here = 1 if processes is None else processes.launch.local_world_size
        self._photos: PhotoSource = (
            HostPhotos(kept_limit(here))
            if device == HOST
            else DevicePhotos(device, host_limit_bytes=kept_limit(here))
        )
        super().__init__(
            run.folder, run.facts, run.config.max_steps, run.config.checkpoint_every, device
        )

    def check_kernels(self) -> None:
        """Compare the kernels in use with their plain definitions; the training stays the same."""
        with own_modes():
            check_kernels(self.state, self.scene, self.config, self._scale)

    def close(self) -> None:
        """Stop saving, and loading photos."""
        super().close()
        self._photos.close()

    def _take_step(self) -> StepStatistics:
        result = self._with_enough_memory(self._step_on_next_views)
        self._align_replicas()
        self._with_enough_memory(lambda: self._control_density(result))
        return result.statistics

    def _step_on_next_views(self) -> StepResult:
        views = [self._with_photos(number) for number in self.state.sampler.next()[self._share]]
        self._fetch_next_views()
        return training_step(
            self.state, views, self.config, self._scale, self._exchange, self._recorder
        )

    def _with_photos(self, number: int) -> PhotographedView:
        view = self.scene.train[number]
        photos = {modality: self._photos.load(image) for modality, image in view.images.items()}
        return PhotographedView(number, view, photos)

    def _stops_now(self, is_asked: bool) -> bool:
        """Processes stop together: after the step in which all have heard that one was asked."""
        if self._processes is None or self._exchange is None:
            return is_asked
        if is_asked:
            self._exchange.ask_to_stop()
        self._processes.stopped = self._exchange.stops and self.state.step < self.config.max_steps
        return self._processes.stopped

    def _align_replicas(self) -> None:
        """Before the Gaussians may change, have the same ones on all processes."""
        if self._processes is None or self._exchange is None:
            return
        if self.state.strategy.may_change_at(self.state.step) and align_replicas(
            self._processes, self.state
        ):
            warn(
                "the machines round differently, so all take the first one's model whenever "
                "Gaussians are added or removed"
            )

    def _control_density(self, result: StepResult) -> None:
        state = self.state
        counts = control_density(state, result, self.config, self._scale.extent)
        if counts is None:
            return
        gaussians = len(state.model.gaussians)
        self.folder.append_log({"step": state.step, **counts, "gaussians": gaussians})
        if gaussians == 0:
            raise TrainingError(
                f"every Gaussian has turned transparent by step {state.step}: check the scene's "
                f"poses and images"
            )

    def _fetch_next_views(self) -> None:
        """Let their photos come while the step is computed, if there is memory for them."""
        following = self.state.sampler.peek()[self._share]
        if not following:
            return
        images = [
            image for number in following for image in self.scene.train[number].images.values()
        ]
        try:
            self._photos.fetch(images)
        except RuntimeError as error:
            if not lacks_memory(error):
                raise
            self._photos.release()

    def _with_enough_memory(self, action: Callable[[], Result]) -> Result:
        """Do a part of a step; see ``retried_when_full``.

        Adam makes its moments at the first step, one parameter after another: this alone is not
        undone.

        Raises:
            TrainingError: a GPU's memory does not suffice; the state before is left as a
                checkpoint.
        """
        state = self.state
        before = (state.step, state.generator.get_state(), state.sampler.state())

        def undo() -> None:
            state.go_back(*before)
            self._photos.release()
            if self._recorder is not None:
                self._recorder.forget()

        try:
            return retried_when_full(action, undo)
        except (LinkError, PeerError):
            undo()
            self._save_last_good_step()
            raise
        except RuntimeError as error:
            if not lacks_memory(error):
                raise
        # Here the memory is free that the error's frames held: a checkpoint needs it.
        raise self._out_of_memory()

    def _out_of_memory(self) -> TrainingError:
        """Leaves a checkpoint of the last good step."""
        state = self.state
        self._save_last_good_step()
        found = self.folder.checkpoints()
        kept = (
            f"the last good step is kept in {found[-1]}" if found else "there is no checkpoint yet"
        )
        go_on = "resume on the CPU, or retrain" if found else "retrain"
        return TrainingError(
            f"the GPU's memory does not suffice for step {state.step + 1:,} with "
            f"{len(state.model.gaussians):,} Gaussians; {kept}: {go_on} with fewer Gaussians or a "
            f"lower resolution",
            options=("max_gaussians", "resolution"),
        )

    def _save_last_good_step(self) -> None:
        """The step that failed has been undone, so that the state is whole."""
        self._step_done = self.state.step
        if self.state.step > 0:
            self._save()

    def _describe_model(self) -> Mapping[str, float | None]:
        """How much the parts of the model say, see ``PartSpreads``."""
        position = self.scene.train[0].camera.position
        spreads = part_spreads(self.state.model, position)
        return {} if spreads is None else spreads.to_json(self.scene.temperature)

    @property
    def _skipped_in_a_row(self) -> int:
        return int(self.state.skipped_in_a_row)

    def _tensors(self) -> Mapping[str, Tensor]:
        return checkpoint.tensors_of(self.state)

    def _write_checkpoint(self, path: Path, facts: CheckpointFacts) -> None:
        if self._processes is None or self._processes.is_first:
            checkpoint.save(path, self.state, facts)


def _share_of(batch: int, processes: Processes | None) -> slice:
    """Which views of a step this process renders."""
    if processes is None:
        return slice(0, batch)
    rank, count = processes.rank, processes.count
    return slice(rank * batch // count, (rank + 1) * batch // count)
