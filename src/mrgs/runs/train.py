"""Training from Python: from a scene to a run, at once or step by step."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
import weakref
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import torch

from mrgs.errors import ConfigError, warn_user
from mrgs.method.config import TrainConfig, make_config
from mrgs.method.density import Strategy
from mrgs.method.losses.term import Term
from mrgs.render import Model, render
from mrgs.run_files.folder import RunFolder
from mrgs.runs.open import Run, load_run
from mrgs.runs.registry import imported
from mrgs.runs.trained_run import asked_cameras
from mrgs.scene import Camera, CameraResponse, Modality, Rendering, Scene
from mrgs.system.gpu import DeviceName
from mrgs.system.threads import require_own_threads
from mrgs.system.torch_modes import own_modes
from mrgs.system.wording import shown
from mrgs.training import start
from mrgs.training.loop import Trainer, Validation
from mrgs.training.start import Hooks, TrainOptions
from mrgs.training.step import StepStatistics

_SCORE = imported("mrgs.evaluation.score_run", "score_during_training")

_OPEN_LOOPS: weakref.WeakSet[Generator[LiveRun, None, None]] = weakref.WeakSet()
"""Loops of runs with a folder, which may not have ended."""


def train(
    scene: Scene | str | Path,
    output: str | Path | None = None,
    config: TrainConfig | None = None,
    *,
    resume: bool = False,
    accept_changes: bool = False,
    device: DeviceName = "auto",
    plain: bool = False,
    tensorboard: bool = False,
    eval_steps: int | None = None,
    stop_at: int | None = None,
    strategy: Strategy | None = None,
    terms: Sequence[Term] = (),
    progress: Callable[[int, int], object] | None = None,
    on_step: Callable[[StepStatistics], object] | None = None,
    on_start: Callable[[Scene, TrainConfig], None] | None = None,
    on_model: Callable[[Model, CameraResponse], None] | None = None,
) -> Run:
    """Train a model of a scene, and open the run.

    Ctrl-C ends the training after the current step with a checkpoint, a second Ctrl-C at once. An
    error in ``on_step`` or ``progress`` ends it with a checkpoint of the last step.

    Args:
        scene: the scene or its folder; one that was read before keeps its resolution.
        output: the run's folder; must not contain a run unless ``resume``. None takes a temporary
            folder, which is removed with the returned run; of a training that is stopped, with this
            process.
        config: what to train, see ``make_config``; what that returns by default if None. A resumed
            run keeps its own.
        resume: continue the run from its newest undamaged checkpoint, exactly; on another device
            up to rounding.
        accept_changes: resume although photos, poses or intrinsics have changed since the run
            began.
        device: "auto" takes the GPU if there is one that can be used.
        plain: run the plain definitions of all operations instead of kernels, much slower; so does
            the environment variable MRGS_PLAIN=1.
        tensorboard: also write the log to the run's folder ``tensorboard``.
        eval_steps: steps between scorings of the held-out views, which are also scored after the
            last, by the metrics of ``evaluate_run`` without LPIPS; the scores are written to the
            log, pictures of a few views to that for TensorBoard. Changes nothing else; its time
            does not count as the training's. None scores none.
        stop_at: leave after this step with a checkpoint, without changing the schedule.
        strategy: density control instead of the configuration's; a resumed run needs it again.
        terms: of the loss, besides the configuration's; one with the name of such a term takes its
            place. A resumed run needs them again.
        progress: called after each step with its number and that of all steps, as by
            ``mrgs.progress_bar``.
        on_step: called with the ``StepStatistics`` of every step; returning True stops with a
            checkpoint.
        on_start: called once, before the model is made, with the scene and the configuration.
        on_model: called once, after that, with the model that is trained, which ``on_step`` may
            read and must not change, and with the response of the scene's cameras to a rendering,
            as learned so far.

    Warns:
        MrgsWarning: a kernel differs from the plain definition of its operation, which is then used
            in its place; the newest checkpoint is damaged and an older one is used; changes of the
            scene are accepted; the GPU's memory does not suffice to score the held-out views; the
            scene has a problem that ``mrgs.check`` finds; or a run without ``output`` was stopped,
            and where it is kept until this process ends.

    Raises:
        SceneError: the scene cannot be used.
        RunError: the output folder cannot be used, or the resumed run had another strategy, other
            terms, or other photos, poses or intrinsics.
        DeviceError: the GPU was asked for and cannot be used.
        ConfigError: a parameter is not what it should be, torch's default type is not float32,
            TensorBoard was asked for and is not installed, or ``eval_steps`` was given and the
            scene holds out no views.
        TrainingError: three steps in a row gave values that are not finite (found up to ten steps
            later on a GPU), the model has such a value, or the GPU's memory does not suffice; the
            last good checkpoint is kept.
    """
    options = TrainOptions(resume, accept_changes, device, plain, tensorboard)
    validation = None if eval_steps is None else Validation(eval_steps, _SCORE)
    hooks, given = Hooks(on_step, on_start, on_model, progress, validation), _checked(config)
    with _run_folder(output) as folder:
        start.train(
            scene, folder.path, given, options, hooks,
            stop_at=stop_at, strategy=strategy, terms=terms,
        )  # fmt: skip
    return replace(load_run(folder.path, scene, device), folder=folder)


def train_steps(
    scene: Scene | str | Path,
    output: str | Path | None = None,
    config: TrainConfig | None = None,
    *,
    resume: bool = False,
    accept_changes: bool = False,
    device: DeviceName = "auto",
    plain: bool = False,
    tensorboard: bool = False,
    eval_steps: int | None = None,
    strategy: Strategy | None = None,
    terms: Sequence[Term] = (),
) -> Generator[LiveRun, None, None]:
    """Train a model of a scene step by step, yielding the run after each step: the loop is the
    caller's.

    With ``output``, leaving the loop early writes a checkpoint, from which ``resume`` continues; so
    do an error in it, Ctrl-C at the end of a step, and the end of the process. The folder is locked
    until then. Arguments and errors as for ``train``, but a temporary folder is removed when
    neither the loop, what it yielded nor a snapshot is left."""
    options = TrainOptions(resume, accept_changes, device, plain, tensorboard)
    hooks = Hooks(validation=None if eval_steps is None else Validation(eval_steps, _SCORE))

    def steps() -> Generator[LiveRun, None, None]:
        with _run_folder(output) as folder:
            opened = start.open_training(
                scene, folder.path, _checked(config), options, hooks, strategy=strategy, terms=terms
            )
            with opened as trainer:
                trainer.check_kernels()
                for statistics in trainer.steps():
                    yield LiveRun(statistics, trainer, folder)

    loop = steps()
    if output is not None:
        _OPEN_LOOPS.add(loop)
    return loop


@atexit.register
def _close_open_loops() -> None:
    """While modules can still be imported, which saving needs."""
    for loop in tuple(_OPEN_LOOPS):
        with suppress(ValueError):  # a thread that outlives this one is in the midst of a step
            loop.close()


@dataclass(frozen=True, eq=False, repr=False)
class LiveRun:
    """A run that is being trained, after one of its steps."""

    statistics: StepStatistics
    _trainer: Trainer
    _folder: RunFolder

    def __repr__(self) -> str:
        count = self.gaussian_count
        return f"LiveRun(step {self.step:,}, loss {self.loss:.4f}, {count:,} Gaussians)"

    @property
    def step(self) -> int:
        """Number of the step, from 1."""
        return self.statistics.step

    @property
    def loss(self) -> float:
        """L_total of the step; not finite if the step was skipped."""
        return self.statistics.loss

    @property
    def gaussian_count(self) -> int:
        """Number of Gaussians now."""
        return len(self.model.gaussians)

    @property
    def model(self) -> Model:
        """The model that is trained, on the training's device; changes with the next step."""
        return self._trainer.state.model

    def render(self, cameras: Camera | Mapping[Modality, Camera]) -> Rendering:
        """Render any camera, one for all modalities or one for each modality to render, with the
        model as it is now, without gradients; in another thread, once the step that is under way is
        done. ValueError if ``cameras`` is something else, or asks for what the scene has no photos
        of; MrgsError if this process was forked from the one that trains, or torch's default type
        is not float32."""
        require_own_threads()
        asked = asked_cameras(cameras, self._trainer.scene.modalities)
        with self._trainer.between_steps(), own_modes(self._trainer.state.device), torch.no_grad():
            return render(self.model, asked)[0].cpu()

    def snapshot(self) -> Run:
        """The run as it is now, rendering on the CPU, to be scored or exported while the training
        goes on; writes a checkpoint and opens it, in another thread once the step that is under way
        is done. RunError if the training has ended, so that ``load_run`` opens it, or the
        checkpoint cannot be written; TrainingError if Ctrl-C has interrupted the step half-way."""
        with self._trainer.between_steps():
            self._trainer.save()
            run = load_run(self._folder.path, self._trainer.scene, "cpu")
        return replace(run, folder=self._folder)


def _checked(config: TrainConfig | None) -> TrainConfig:
    """The configuration, or the usual one where there is none. ConfigError for anything else."""
    if config is None or isinstance(config, TrainConfig):
        return config or make_config()
    raise ConfigError(
        f"config must be what make_config returns, not {shown(config)}: such as "
        f"make_config(max_steps=2000)",
        options=("config",),
    )


class TemporaryRunFolder(RunFolder):
    """A run's folder among the system's temporary files, removed with this object, or, once it is
    kept, with the process."""

    _kept: ClassVar[list[TemporaryRunFolder]] = []

    def __init__(self) -> None:
        super().__init__(tempfile.mkdtemp(prefix="mrgs-"))
        weakref.finalize(self, _remove_own, self.path, os.getpid())

    def keep(self) -> None:
        """Keep the folder as long as the process lives."""
        self._kept.append(self)


def _remove_own(folder: Path, owner: int) -> None:
    """Remove a folder, unless this process is a fork of the one that made it."""
    if os.getpid() == owner:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _run_folder(output: str | Path | None) -> Iterator[RunFolder]:
    """The folder of a training, which takes place within this block: one that is stopped keeps its
    checkpoints, also in a temporary folder. MrgsWarning, which names it."""
    folder = TemporaryRunFolder() if output is None else RunFolder(output)
    try:
        yield folder
    except (Exception, KeyboardInterrupt):
        if isinstance(folder, TemporaryRunFolder) and folder.checkpoints():
            folder.keep()
            warn_user(
                f"the run is kept in {folder.path} until this process ends: continue it with "
                f"output={str(folder.path)!r} and resume=True, or open it with load_run"
            )
        raise
