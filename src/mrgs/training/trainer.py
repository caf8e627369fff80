"""The training loop of a model of Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from torch import Tensor

from mrgs.errors import TrainingError, warn_user
from mrgs.method.config import TrainConfig
from mrgs.method.losses.term import SceneScale
from mrgs.method.parts import part_spreads
from mrgs.system.gpu import HOST, lacks_memory
from mrgs.system.operation import is_plain
from mrgs.system.torch_modes import own_modes
from mrgs.training import checkpoint
from mrgs.training.device_photos import DevicePhotos
from mrgs.training.driver import Driver
from mrgs.training.facts import CheckpointFacts
from mrgs.training.kernel_check import check_kernels
from mrgs.training.memory import retried_when_full
from mrgs.training.photos import HostPhotos, PhotoSource
from mrgs.training.pose_check import PoseCheck, checks_poses_now
from mrgs.training.recorder import Recorder
from mrgs.training.start import TrainingStart
from mrgs.training.state import TrainingState
from mrgs.training.step import (
    StepResult,
    StepStatistics,
    control_density,
    training_step,
)
from mrgs.training.view_pass import PhotographedView

Result = TypeVar("Result")


class Trainer(Driver[StepStatistics]):
    """Trains Gaussians: choose views, take a step on them, control the density.

    Attributes:
        folder: of the run, locked.
        scene: that is trained on.
        config: in force.
        state: all that changes during training.
    """

    def __init__(self, run: TrainingStart[TrainConfig, TrainingState]) -> None:
        self.folder, self.scene, self.config, self.state = (
            run.folder,
            run.scene,
            run.config,
            run.state,
        )
        device = run.state.device
        self._scale = SceneScale.of(run.scene)
        self._recorder = Recorder(device) if device.type == "cuda" and not is_plain() else None
        self._photos: PhotoSource = HostPhotos() if device == HOST else DevicePhotos(device)
        super().__init__(
            run.folder, run.facts, run.config.max_steps, run.config.checkpoint_every, device
        )

    def check_kernels(self) -> None:
        """Compare the kernels in use with their plain definitions; the training stays the same."""
        with own_modes(self.state.device):
            check_kernels(self.state, self.scene, self.config, self._scale)

    def close(self) -> None:
        """Stop saving, and loading photos."""
        super().close()
        self._photos.close()

    def _take_step(self) -> StepStatistics:
        result = self._with_enough_memory(self._step_on_next_views)
        if checks_poses_now(self.state, self.config):
            self._check_poses()
        self._with_enough_memory(lambda: self._control_density(result))
        return result.statistics

    def _step_on_next_views(self) -> StepResult:
        views = [self._with_photos(number) for number in self.state.sampler.next()]
        self._fetch_next_views()
        return training_step(self.state, views, self.config, self._scale, self._recorder)

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
                f"{self.scene.name}: the poses of the training photos are off by some "
                f"{photo_px:.1f} pixels, so they are refined with the model"
            )
            poses.begin(self._with_enough_memory(check.motions))
            if self._recorder is not None:
                self._recorder.forget()
        poses.note_checked()

    def _with_photos(self, number: int) -> PhotographedView:
        view = self.scene.train[number]
        photos = {modality: self._photos.load(image) for modality, image in view.images.items()}
        return PhotographedView(number, view, photos)

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
        following = self.state.sampler.peek()
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
        checkpoint.save(path, self.state, facts)
