"""A trained run, opened to be rendered from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.data import load_scene
from mrgs.errors import SceneError
from mrgs.render import Model, Rendering, bake_temperatures, render
from mrgs.scene import Camera, Scene, TemperatureRange
from mrgs.training.checkpoint import CheckpointFacts, load_model, require_same_scene
from mrgs.training.config import TrainConfig
from mrgs.training.run_folder import RunFolder


@dataclass(frozen=True, eq=False)
class Run:
    """A run's newest checkpoint.

    Attributes:
        folder: the run's folder.
        config: what it was trained with.
        model: what it learned, its temperatures computed once for all views.
        facts: steps, scene, temperature scale, cost.
    """

    folder: RunFolder
    config: TrainConfig
    model: Model
    facts: CheckpointFacts

    @property
    def temperature(self) -> TemperatureRange | None:
        """The scale of the thermal values; None if the scene has no known °C."""
        return self.facts.temperature

    def render(self, camera: Camera | None, thermal_camera: Camera | None = None) -> Rendering:
        """Render any camera, without gradients: both modalities from ``camera``, or thermal from a camera of its own.

        Args:
            camera: of the RGB image, and of the thermal image unless that has its own; None leaves RGB out.
            thermal_camera: of the thermal image.
        """
        with torch.no_grad():
            return render(self.model, camera, thermal_camera if thermal_camera is not None else camera)[0]

    def temperatures_c(self, rendering: Rendering) -> Float[Tensor, "h w"]:
        """The rendered temperatures in °C.

        Raises:
            ValueError: the scene has no known °C, or the rendering no thermal image.
        """
        if self.temperature is None or rendering.thermal is None:
            raise ValueError("no °C: the scene has no temperature range, or the rendering has no thermal image")
        return self.temperature.to_celsius(rendering.thermal[..., 0])

    def load_scene(self) -> Scene:
        """The scene that the run was trained on, at the run's resolution.

        Raises:
            SceneError: the scene is no longer where it was, or cannot be used.
            RunError: the scene has other cameras or another temperature range than the run was trained with.
        """
        if not Path(self.facts.scene).exists():
            raise SceneError(
                f"{self.facts.scene}: the scene that {self.folder.path} was trained on is no longer there; "
                "say where it is with --scene"
            )
        scene = load_scene(self.facts.scene, resolution=self.config.resolution, seed=self.config.seed)
        require_same_scene(self.facts, scene)
        return scene


def load_run(path: str | Path, scene: str | Path | None = None) -> Run:
    """Open a run's newest checkpoint.

    Args:
        path: the run's folder.
        scene: the scene's folder, where it is no longer at the place it was trained from.

    Raises:
        RunError: the folder is not a run, or its checkpoint cannot be used.
    """
    folder = RunFolder(path)
    newest = folder.newest_checkpoint()
    config = folder.read_config()
    model, facts = load_model(newest, config)
    if scene is not None:
        facts = facts._replace(scene=str(Path(scene).resolve()))
    return Run(folder, config, bake_temperatures(model), facts)
