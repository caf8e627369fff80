"""A trained run, opened to be rendered from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.system import gpu
from mrgs.data import load_scene
from mrgs.errors import DeviceError, RunError, SceneError
from mrgs.system.gpu import HOST, DeviceName
from mrgs.render import Model, Rendering, bake_temperature_residuals, render
from mrgs.scene import Camera, Scene, TemperatureRange, View
from mrgs.baselines.thermonerf import ThermoNerfConfig
from mrgs.baselines.thermonerf.checkpoint import load_model as load_thermonerf
from mrgs.baselines.thermonerf.model import ThermoNerf
from mrgs.baselines.thermonerf.run_files import holds_thermonerf, read_config
from mrgs.training.checkpoint import CheckpointFacts, load_model, require_same_scene
from mrgs.method.config import TrainConfig
from mrgs.method.camera_model.image_model import ImageModel
from mrgs.training.run_folder import RunFolder


@dataclass(frozen=True, eq=False)
class TrainedRun(ABC):
    """A run's newest checkpoint, whatever its method; what scoring and rendering need.

    Attributes:
        folder: the run's folder.
        config: what it was trained with.
        facts: steps, scene, temperature scale, cost.
    """

    folder: RunFolder
    config: TrainConfig | ThermoNerfConfig
    facts: CheckpointFacts

    @abstractmethod
    def render_cameras(self, rgb_camera: Camera | None, thermal_camera: Camera | None) -> Rendering:
        """Render the modalities that have a camera, without gradients."""

    @property
    @abstractmethod
    def gaussian_count(self) -> int | None:
        """How many Gaussians the model has; None if the method has none."""

    @property
    def temperature(self) -> TemperatureRange | None:
        """The scale of the thermal values; None if the scene has no known °C."""
        return self.facts.temperature

    def render(self, camera: Camera | None, thermal_camera: Camera | None = None) -> Rendering:
        """Render any camera, without gradients: both modalities from ``camera``, or thermal from a
        camera of its own.

        Args:
            camera: of the RGB image, and of the thermal image unless that has its own; None leaves
                RGB out.
            thermal_camera: of the thermal image.
        """
        return self.render_cameras(camera, thermal_camera if thermal_camera is not None else camera)

    def render_view(self, view: View) -> Rendering:
        """Render a view from its own cameras, without gradients."""
        return self.render_cameras(
            view.rgb.camera if view.rgb else None, view.thermal.camera if view.thermal else None
        )

    def photograph(self, rendering: Rendering, camera: Camera) -> Rendering:
        """The rendering of a camera as the scene's cameras would have written it there, to be
        compared with photos.

        The same, unless the method has learned what the cameras do to the images.
        """
        return rendering

    def temperatures_c(self, rendering: Rendering) -> Float[Tensor, "h w"]:
        """The rendered temperatures in °C.

        Raises:
            ValueError: the scene has no known °C, or the rendering no thermal image.
        """
        if self.temperature is None or rendering.thermal is None:
            raise ValueError(
                "no °C: the scene has no temperature range, or the rendering has no thermal image"
            )
        return self.temperature.to_celsius(rendering.thermal[..., 0])

    def load_scene(self) -> Scene:
        """The scene that the run was trained on, at the run's resolution.

        Raises:
            SceneError: the scene is no longer where it was, or cannot be used.
            RunError: the scene has other cameras or another temperature range than the run was
                trained with.
        """
        if not Path(self.facts.scene).exists():
            raise SceneError(
                f"{self.facts.scene}: the scene that {self.folder.path} was trained on is no "
                f"longer there; "
                "say where it is with --scene"
            )
        scene = load_scene(
            self.facts.scene, resolution=self.config.resolution, seed=self.config.seed
        )
        require_same_scene(self.facts, scene)
        return scene


@dataclass(frozen=True, eq=False)
class Run(TrainedRun):
    """A run with Gaussians. It may render on a GPU; its model and its images are in the host's
    memory all the same.

    Attributes:
        model: what it learned, t̂ computed once for all views.
        image_model: what the cameras do to the images, as far as it was learned.
        device: where it renders.
    """

    config: TrainConfig
    model: Model
    image_model: ImageModel
    device: torch.device = HOST

    @cached_property
    def _rendered(self) -> Model:
        """The model where it is rendered."""
        return self.model.to(self.device)

    def render_cameras(self, rgb_camera: Camera | None, thermal_camera: Camera | None) -> Rendering:  # noqa: D102
        try:
            with torch.no_grad():
                return render(self._rendered, rgb_camera, thermal_camera)[0].cpu()
        except torch.cuda.OutOfMemoryError:
            raise DeviceError(
                f"the GPU's memory does not suffice to render {self.gaussian_count:,} Gaussians: "
                f"use --device cpu"
            ) from None

    def photograph(self, rendering: Rendering, camera: Camera) -> Rendering:  # noqa: D102
        return self.image_model.expected(rendering, camera)

    @property
    def gaussian_count(self) -> int:  # noqa: D102
        return len(self.model.gaussians)


@dataclass(frozen=True, eq=False)
class ThermoNerfRun(TrainedRun):
    """A run of ``--method thermonerf``: it can be rendered and scored, but has no Gaussians.

    Attributes:
        model: what it learned.
    """

    config: ThermoNerfConfig
    model: ThermoNerf

    def render_cameras(self, rgb_camera: Camera | None, thermal_camera: Camera | None) -> Rendering:  # noqa: D102
        return self.model.render(rgb_camera, thermal_camera)

    @property
    def gaussian_count(self) -> None:  # noqa: D102
        return None


def open_run(
    path: str | Path, scene: str | Path | None = None, device: DeviceName = "auto"
) -> Run | ThermoNerfRun:
    """Open the newest checkpoint of a run of any method, to render and to score it.

    Args:
        path: the run's folder.
        scene: the scene's folder, where it is no longer at the place it was trained from.
        device: where it renders, whatever it was trained on; "auto" takes the GPU where there is
            one that can be used. A ThermoNeRF renders on the CPU.

    Raises:
        RunError: the folder is not a run, or its checkpoint cannot be used.
        DeviceError: the GPU was asked for and cannot be used.
    """
    folder = RunFolder(path)
    if not holds_thermonerf(folder):
        return load_run(path, scene, device)
    if device == "cuda":
        raise DeviceError(
            f"{path} is a ThermoNeRF run, which works on the CPU alone: leave --device out"
        )
    newest = folder.newest_checkpoint()
    config = read_config(folder)
    model, facts = load_thermonerf(newest, config)
    return ThermoNerfRun(folder, config, _moved(facts, scene), model)


def load_run(path: str | Path, scene: str | Path | None = None, device: DeviceName = "auto") -> Run:
    """Open the newest checkpoint of a run with Gaussians.

    Args:
        path: the run's folder.
        scene: the scene's folder, where it is no longer at the place it was trained from.
        device: where it renders, see ``open_run``.

    Raises:
        RunError: the folder is not a run, its method has no Gaussians, or its checkpoint cannot be
            used.
        DeviceError: the GPU was asked for and cannot be used.
    """
    folder = RunFolder(path)
    newest = folder.newest_checkpoint()
    if holds_thermonerf(folder):
        raise RunError(
            f"{path} is a ThermoNeRF run: it has no Gaussians to export, view or report on; "
            "`mrgs eval` and `mrgs render` work with it"
        )
    config = folder.read_config()
    model, facts, image_model = load_model(newest, config)
    chosen = gpu.choose_device(device)
    return Run(
        folder, config, _moved(facts, scene), bake_temperature_residuals(model), image_model, chosen
    )


def _moved(facts: CheckpointFacts, scene: str | Path | None) -> CheckpointFacts:
    """The facts with the place where the scene is now, if that is given."""
    return facts if scene is None else facts._replace(scene=str(Path(scene).resolve()))
