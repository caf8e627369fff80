"""Opening a trained run of any method."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.errors import ConfigError, DeviceError, RunError
from mrgs.method.camera_model.image_model import ImageModel
from mrgs.method.camera_model.pose_refinement import PoseRefinement
from mrgs.method.config import TrainConfig, from_yaml
from mrgs.render import Model, bake_temperature_residuals, render
from mrgs.run_files.facts import require_scene
from mrgs.run_files.folder import RunFolder
from mrgs.runs.registry import Method, find_method
from mrgs.runs.trained_run import TrainedRun
from mrgs.scene import NOT_COARSER, Box, Camera, Modality, Rendering, Scene
from mrgs.scene.view import moved_view
from mrgs.survey import SURVEY_FILE, Survey, keep_crop, read_survey
from mrgs.system import gpu
from mrgs.system.gpu import HOST, DeviceName, lacks_memory
from mrgs.system.threads import will_compute
from mrgs.system.torch_modes import own_modes
from mrgs.training.checkpoint import load_model
from mrgs.training.kernel_check import check_rendering, warn_of_missing

__all__ = ["Run", "TrainedRun", "load_run", "method_of", "open_gaussians", "open_run"]


@dataclass(frozen=True, eq=False, repr=False)
class Run(TrainedRun):
    """A run with Gaussians: its model, with t̂ computed once for all views, and what the cameras do
    to the images, as learned. It may render on a GPU, its ``device``; model and images are in the
    host's memory in any case. The model is without ``left_out`` Gaussians outside ``crop``."""

    config: TrainConfig
    model: Model
    image_model: ImageModel
    device: torch.device = HOST
    crop: Box | None = None
    left_out: int = 0

    @cached_property
    def _rendered(self) -> Model:
        """The model where it is rendered."""
        return self.model.to(self.device)

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """Modalities that the run renders: those of which its scene has photos. The model has RGB
        and thermal values in any case."""
        captured = self.facts.modalities
        return tuple(each for each in self.model.gaussians.modalities if each in captured)

    def render_cameras(self, cameras: Mapping[Modality, Camera]) -> Rendering:
        """The images; the depth of the surface is found when it is asked for."""
        with self._computing(), torch.no_grad():
            rendering = render(self._rendered, cameras)[0].cpu()
        depths = {each: partial(self._median_depth, each, cameras[each]) for each in rendering}
        return Rendering(rendering, depths)

    def _median_depth(self, modality: Modality, camera: Camera) -> Float[Tensor, "h w"]:
        with self._computing():  # on the host, where it is found in any case
            return self.model.median_depth(modality, camera).cpu()

    @contextmanager
    def _computing(self) -> Iterator[None]:
        """Around what is computed. DeviceError if the GPU's memory does not suffice; MrgsError if
        this process was forked from one that has computed, or torch's default type is not float32.
        """
        will_compute()
        try:
            with own_modes(self.device):
                yield
        except RuntimeError as error:
            if not lacks_memory(error):
                raise
            raise DeviceError(
                f"the GPU's memory does not suffice to render {self.gaussian_count:,} Gaussians: "
                f"use the CPU",
                options=("device",),
            ) from None

    def camera_response(  # noqa: D102
        self,
        rendering: Rendering,
        camera: Camera,
        pixel_sizes: Mapping[Modality, float] = NOT_COARSER,
    ) -> Rendering:
        return self.image_model.expected(rendering, camera, pixel_sizes)

    def load_scene(self) -> Scene:
        """The scene that the run was trained on, at the run's resolution, its training views with
        the poses that the run has refined, if it has; see ``TrainedRun.load_scene``."""
        scene, poses = super().load_scene(), self.image_model.poses
        if poses is None or not poses.moves:
            return scene
        return with_refined_poses(scene, poses)

    def with_parts_changed(self, change: Callable[[Model], Mapping[str, Model]]) -> dict[str, Run]:
        """Copies of this run by name, to be rendered: their models, which ``change`` makes of this
        one's, are on the run's device. DeviceError if the GPU's memory does not suffice."""
        with self._computing():
            models = change(self._rendered)
        return {name: replace(self, model=model) for name, model in models.items()}

    def cropped(self, box: Box | None = None) -> Run:
        """This run without the Gaussians whose centres are outside a box in world coordinates, by
        default the one in the survey of its folder; itself without either. A cropped run keeps what
        is in both boxes. ConfigError if none is inside, or the survey has a value that cannot be.
        """
        source = "crop"
        if box is None:
            file = self.folder.path / SURVEY_FILE
            source, box = f"{file}: crop", self.box_in(read_survey(file))
            if box is None:
                return self
        gaussians, residuals = self.model.gaussians, self.model.temperature_residuals
        inside = box.contains(gaussians.means)
        if not inside.any():
            low, high = np.percentile(gaussians.means.numpy(), [2, 98], axis=0).tolist()
            raise ConfigError(
                f"{source}: no Gaussian is in the box {box}; nearly all are in {Box(low, high)}"
            )
        rows = inside.nonzero()[:, 0]
        model = replace(
            self.model,
            gaussians=gaussians.rows(rows),
            neighbours=None,  # not read once t̂ is known
            temperature_residuals=None if residuals is None else residuals[rows],
        )
        left_out = self.left_out + len(inside) - len(rows)
        crop = box if self.crop is None else box.within(self.crop)
        return replace(self, model=model, crop=crop, left_out=left_out)

    def box_in(self, survey: Survey) -> Box | None:
        """The box that a survey states, as high as the model where it states outlines alone; None
        without either. ConfigError if that has no inside."""
        outlines, z = survey.crop_outlines or (), self.model.gaussians.means[:, 2]
        if survey.crop is not None:
            return Box.between(*survey.crop, outlines)
        return Box.around(outlines, z.min().item(), z.max().item()) if outlines else None

    def keep(self, box: Box | None) -> None:
        """Let the survey of the run's folder state a box for ``cropped``, or none; ``undo_keep``
        takes that back. Errors as for ``cropped``, and RunError if it cannot be written."""
        if box is not None:
            self.cropped(box)
        stated = (None, None) if box is None else ((*box.low, *box.high), box.outlines or None)
        keep_crop(self.folder.path, stated)

    def undo_keep(self) -> None:
        """Let the survey state what it did before the last ``keep``, of whatever process; errors as
        for that, and ConfigError if there is nothing to undo."""
        keep_crop(self.folder.path, None)

    @property
    def gaussian_count(self) -> int:
        """How many Gaussians the model has."""
        return len(self.model.gaussians)


def open_run(
    path: str | Path, scene: Scene | str | Path | None = None, device: DeviceName = "auto"
) -> TrainedRun:
    """Open the newest checkpoint of a run of any method, to render and to score it; an older one if
    it is damaged.

    Args:
        path: the run's folder.
        scene: the scene's folder, if it has moved since training; the scene itself, if it was made
            from arrays.
        device: where it renders, whatever it was trained on; "auto" takes the GPU where there is
            one that the method can use.

    Warns:
        MrgsWarning: an older checkpoint is used; a kernel that rendering uses differs from the
            plain definition of its operation, which is then used in its place; or the run was
            trained with a definition that this process has not replaced.

    Raises:
        RunError: the folder is not a run, its method is not registered, or its checkpoint cannot be
            used.
        SceneError: ``scene`` is neither a scene nor a path.
        DeviceError: the requested GPU cannot be used.
        ConfigError: torch's default type is not float32.
    """
    folder = RunFolder(path)
    folder.newest_checkpoint()
    if scene is not None:
        require_scene(scene)
    if not isinstance(scene, Scene):
        return cast(TrainedRun, method_of(folder).open(path, scene, device))
    run = cast(TrainedRun, method_of(folder).open(path, scene.path or None, device))
    return replace(run, scene=scene)


def load_run(
    path: str | Path, scene: Scene | str | Path | None = None, device: DeviceName = "auto"
) -> Run:
    """Open the newest checkpoint of a run with Gaussians; the arguments, warnings and errors are
    those of ``open_run``. RunError if the run's method has no Gaussians."""
    run = open_run(path, scene, device)
    if not isinstance(run, Run):
        raise RunError(
            f"{path} is a run of {run.config.method}, which has no Gaussians to export, view or "
            f"report on; `mrgs eval` and `mrgs render` work with it"
        )
    return run


def method_of(folder: RunFolder) -> Method:
    """The method of a run. RunError if the folder is not a run, or its method is not registered."""
    name = folder.method
    try:
        return find_method(name)
    except ConfigError as error:
        raise RunError(f"{folder.path} is a run of a method that is not registered: {error}") from (
            error
        )


def open_gaussians(
    path: str | Path, scene: str | Path | None = None, device: DeviceName = "auto"
) -> Run:
    """Open the newest checkpoint of a run that ``mrgs.train`` trained; see ``open_run``."""
    folder = RunFolder(path)
    config = folder.read_whole_config(from_yaml)
    chosen = gpu.choose_device(device)
    will_compute()
    with own_modes(chosen):
        model, facts, image_model = folder.load_newest(lambda file: load_model(file, config))
        check_rendering(model, image_model, *dict.fromkeys([HOST, chosen]))
        warn_of_missing(folder.custom_parts)
        model = bake_temperature_residuals(model)
    return Run(folder, config, facts.moved_to(scene), model, image_model, chosen)


def with_refined_poses(scene: Scene, poses: PoseRefinement) -> Scene:
    """The scene with the poses of its training views as they were refined on it, and a note of how
    far they were moved, in pixels of each view's first camera; held-out views keep theirs."""
    views, shifts = scene.train, poses.shifts().tolist()
    train = tuple(map(moved_view, views, poses.all_motions()))
    pixels = [shift * view.camera.focal_px for shift, view in zip(shifts, views, strict=True)]
    farthest = max(range(len(views)), key=pixels.__getitem__)
    note = (
        f"the poses of the training photos were refined, by {sum(pixels) / len(pixels):.1f} px on "
        f"average and at most {pixels[farthest]:.1f} px ({views[farthest].name})"
    )
    return replace(scene, train=train, notes=(*scene.notes, note))
