"""The training loop of a model of Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import torch

from mrgs.errors import ConfigError, DeviceError, NotFiniteError, RunError, TrainingError, warn_user
from mrgs.method.config import TrainConfig
from mrgs.method.losses.term import SceneScale
from mrgs.method.parts import part_spreads
from mrgs.run_files.facts import CheckpointFacts
from mrgs.run_files.folder import Pictures, RunFolder
from mrgs.run_files.record import RunRecord, asks_to_stop
from mrgs.scene import Scene
from mrgs.system.gpu import lacks_memory
from mrgs.system.operation import kernels_disabled
from mrgs.system.strict_yaml import whole_number
from mrgs.system.threads import FairLock, ctrl_c_waits, require_own_threads
from mrgs.system.torch_modes import own_modes
from mrgs.training import checkpoint
from mrgs.training.kernel_check import check_kernels, custom_definitions
from mrgs.training.photos import TrainingPhotos
from mrgs.training.pose_check import PoseCheck, checks_poses_now
from mrgs.training.recorder import Recorder
from mrgs.training.state import TrainingState
from mrgs.training.step import StepResult, StepStatistics, control_density, training_step
from mrgs.training.view_pass import PhotographedView

Result = TypeVar("Result")


@dataclass(frozen=True)
class Validation:
    """Scoring of the held-out views while a model is trained, every ``every`` steps and after the
    last. ``score`` returns numbers by name for the log and pictures for TensorBoard, and leaves the
    training as it is. ConfigError if ``every`` is not a whole number from 1."""

    every: int
    score: Callable[[Trainer], tuple[Mapping[str, float], Pictures]]

    def __post_init__(self) -> None:
        if whole_number(self.every, "eval_steps") < 1:
            why = f"eval_steps must be at least 1, not {self.every}"
            raise ConfigError(why, options=("eval_steps",))


class Trainer:
    """Trains Gaussians: choose views, take a step on them, control the density; log, checkpoint.
    The run's folder is locked by the caller; the scene has the run's resolution."""

    def __init__(
        self,
        folder: RunFolder,
        facts: CheckpointFacts,
        scene: Scene,
        config: TrainConfig,
        state: TrainingState,
        validation: Validation | None = None,
    ) -> None:
        self.folder, self.scene, self.config, self.state = folder, scene, config, state
        self.facts, self._validation = facts, validation
        device = state.device
        self._record = RunRecord(
            folder,
            facts,
            config,
            tensors=lambda: checkpoint.tensors_of(state),
            write=lambda path, facts: checkpoint.save(path, state, facts),
            describe=partial(_spreads, state, scene),
            device=device,
            skipped_in_a_row=int(state.skipped_in_a_row),
        )
        self._scale = SceneScale.of(scene)
        records = device.type == "cuda" and not kernels_disabled()
        self._recorder = Recorder(device) if records else None
        self._photos = TrainingPhotos(device)
        self._turns = FairLock()
        self._is_half_done = self._is_closed = False

    def check_kernels(self) -> None:
        """Compare the kernels in use with their plain definitions; the training stays the same."""
        with own_modes(self.state.device):
            check_kernels(self.state, self.scene, self.config, self._scale)
        self.folder.note_custom_parts(custom_definitions())

    def run(
        self,
        stop_at: int | None = None,
        on_step: Callable[[StepStatistics], object] | None = None,
        progress: Callable[[int, int], object] | None = None,
    ) -> None:
        """Train until the schedule's end, the step ``stop_at``, or ``on_step`` returns True;
        ``progress`` is called after each step with its number and that of all. The last step is
        checkpointed, also after Ctrl-C or an error in what is called."""
        with closing(self.steps(stop_at)) as steps:
            for statistics in steps:
                if progress is not None:
                    progress(statistics.step, self.config.max_steps)
                if on_step is not None and asks_to_stop(on_step(statistics)):
                    break

    def steps(self, stop_at: int | None = None) -> Generator[StepStatistics, None, None]:
        """Train until the end of the schedule, the step ``stop_at``, or until closed; the last step
        is checkpointed, also if Ctrl-C ends the training."""
        last = self.config.max_steps if stop_at is None else min(stop_at, self.config.max_steps)
        while self._record.step < last:
            try:
                statistics = self._next_step()
                self._validate_if_due()
                yield statistics
            except BaseException:  # unless the step itself failed
                if not self._is_half_done:
                    self.save()
                raise
            self._record.save_if_due(last)

    def _validate_if_due(self) -> None:
        """Score the held-out views if it is time; MrgsWarning if the GPU's memory does not suffice.
        Other threads wait for the end; Ctrl-C does not, unless the caller postpones it."""
        validation, step = self._validation, self._record.step
        if validation is None or (step % validation.every and step != self.config.max_steps):
            return
        with self._record.paused(), self.between_steps():
            try:
                numbers, pictures = validation.score(self)
            except (DeviceError, RuntimeError) as error:
                if not isinstance(error, DeviceError) and not lacks_memory(error):
                    raise
                # Without the step, so that a full memory is reported once and not at every scoring.
                warn_user(
                    f"{self.scene.name}: held-out views were not scored: the GPU's memory does not "
                    f"suffice for it beside the training, which goes on; score the finished run"
                )
                return
            self.folder.append_log({"step": step, **numbers}, pictures)

    def save(self) -> None:
        """Write a checkpoint of the last step; Ctrl-C waits for its end. NotFiniteError if the
        state has a NaN or an infinity; TrainingError if the step was interrupted half-way; RunError
        if the training has ended, or the checkpoint cannot be written; MrgsError if this process
        was forked from the one that trains."""
        require_own_threads()
        with ctrl_c_waits(), self.between_steps():
            if self._is_closed:
                path = str(self.folder.path)
                raise RunError(f"the training has ended: open the run with load_run({path!r})")
            if self._is_half_done:
                raise TrainingError(
                    f"step {self._record.step + 1} was interrupted half-way and cannot be saved: "
                    f"resume from the last checkpoint"
                )
            self._record.save()

    def close(self) -> None:
        """Stop saving, since the folder may become another training's, and loading photos."""
        with self.between_steps():
            self._is_closed = True
        self._photos.close()
        self._release()

    def between_steps(self) -> AbstractContextManager[None]:
        """Within this block no other thread takes a step or writes a checkpoint."""
        return self._turns.taken()

    def _next_step(self) -> StepStatistics:
        """Take a whole step, and log it; Ctrl-C waits for its end."""
        require_own_threads()
        with ctrl_c_waits(), self.between_steps(), own_modes(self.state.device):
            self._is_half_done = True
            try:
                statistics = self._take_step()
            except NotFiniteError as error:
                raise self._record.error(str(error), NotFiniteError) from error
            self._record.add(statistics)
            self._is_half_done = False
        return statistics

    def _take_step(self) -> StepStatistics:
        result = self._with_enough_memory(self._step_on_next_views)
        if checks_poses_now(self.state, self.config):
            self._check_poses()
        self._with_enough_memory(lambda: self._control_density(result))
        return result.statistics

    def _step_on_next_views(self) -> StepResult:
        views = [self._with_photos(number) for number in self.state.sampler.next()]
        # Read while this step is computed; at the end of a round, the next view is not drawn yet.
        if following := [self.scene.train[number] for number in self.state.sampler.peek()]:
            self._photos.fetch([image for view in following for image in view.images.values()])
        return training_step(self.state, views, self.config, self._scale, self._recorder)

    def _with_photos(self, number: int) -> PhotographedView:
        view = self.scene.train[number]
        photos = {modality: self._photos.load(image) for modality, image in view.images.items()}
        return PhotographedView(number, view, photos)

    def _check_poses(self) -> None:
        """Refine the poses of the training photos from here on, if they turn out to be wrong."""
        poses = self.state.image_model.poses
        assert poses is not None
        check = PoseCheck(self.state, self._with_photos, self.config)
        found = self._with_enough_memory(check.agreement)
        photo_px = self._with_enough_memory(check.pixel_size) * found.agreed_px
        self.folder.append_log({"step": self.state.step, "pose_error_px": photo_px})
        if found.is_wrong:
            warn_user(
                f"{self.scene.name}: the poses of the training photos are off by about "
                f"{photo_px:.1f} pixels and will be refined during training"
            )
            poses.begin(self._with_enough_memory(check.motions))
            if self._recorder is not None:
                self._recorder.forget()
        poses.note_checked()

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

    def _with_enough_memory(self, action: Callable[[], Result]) -> Result:
        """Do a part of a step, which changes the state only once it has all the memory that it
        needs; if the GPU's is full, undo it, release what is reserved or kept for speed, and do it
        again. Adam's moments at the first step are not undone. TrainingError if it is full again;
        the state before is checkpointed."""
        state = self.state
        before = (state.step, state.generator.get_state(), state.sampler.state())
        for _ in range(2):
            try:
                return action()
            except RuntimeError as error:
                if not lacks_memory(error):
                    raise
            # The memory of the error's frames is free here, outside of the except block.
            state.go_back(*before)
            self._release()
            torch.cuda.empty_cache()
        self._record.step = state.step
        if state.step > 0:
            self._record.save()
        kept = "there is no checkpoint yet: retrain"
        if found := self.folder.checkpoints():
            kept = f"the last good step is kept in {found[-1]}: resume on the CPU, or retrain"
        raise TrainingError(
            f"the GPU's memory does not suffice for step {state.step + 1:,} with "
            f"{len(state.model.gaussians):,} Gaussians; {kept} with fewer Gaussians or a lower "
            f"resolution",
            options=("max_gaussians", "resolution"),
        )

    def _release(self) -> None:
        """Give back the GPU's memory that is kept for speed."""
        self._photos.release()
        if self._recorder is not None:
            self._recorder.forget()


def _spreads(state: TrainingState, scene: Scene) -> Mapping[str, float | None]:
    spreads = part_spreads(state.model, scene.train[0].camera.position)
    return {} if spreads is None else spreads.to_json(scene.temperature)
