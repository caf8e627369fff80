"""A training of a model of Gaussians: opened, checked, and run to its end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from copy import deepcopy
from pathlib import Path
from typing import NamedTuple

import torch

from mrgs.errors import ConfigError
from mrgs.method.config import TrainConfig, from_yaml
from mrgs.method.density import Strategy
from mrgs.method.losses.term import Term
from mrgs.render import Model
from mrgs.scene import CameraResponse, Scene
from mrgs.system import gpu
from mrgs.system.disk import warn_if_short
from mrgs.system.gpu import HOST, DeviceName
from mrgs.system.limits import whole_number
from mrgs.system.operation import is_plain
from mrgs.training import checkpoint
from mrgs.training.compilation import shared_compiling
from mrgs.training.memory import checkpoint_bytes
from mrgs.training.run_folder import CHECKPOINTS_KEPT, RunFolder
from mrgs.training.start import TrainingStart, start_training
from mrgs.training.state import TrainingState, initial_state
from mrgs.training.step import StepStatistics
from mrgs.training.trainer import Trainer

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
    with (
        shared_compiling(config) if on_kernels else nullcontext(),
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
        ) as run,
    ):
        _require_enough_views(run, len(run.scene.train) if part is None else len(part.views))
        _check_room(run)
        if part is not None:
            run.state.sampler.restrict(part.views)
        # A resumed run goes on with the cameras as they are now.
        run.state.model.dilation = run.config.dilation_of(run.facts.capture)
        with closing(Trainer(run)) as trainer:
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
        part: of the scene to which the training is limited; a resumed run needs it again.

    Warns:
        MrgsWarning: a kernel differs from the plain definition of its operation, which is then used
            in its place; the newest checkpoint is damaged and an older one is used; changes of the
            scene are accepted; or the scene has a problem.

    Raises:
        SceneError: the scene cannot be used.
        RunError: the output folder cannot be used, or the resumed run had another strategy, other
            terms, or other photos, poses or intrinsics.
        DeviceError: the GPU was asked for and cannot be used.
        ConfigError: a parameter is not what it should be, TensorBoard was asked for and is not
            installed, or a step has more views than the scene.
        TrainingError: three steps in a row gave values that are not finite (on a GPU this is found
            up to ten steps later), the model holds such a value (found up to a hundred steps
            later, and always before it is saved), or the GPU's memory does not suffice; the last
            good checkpoint is kept.
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
