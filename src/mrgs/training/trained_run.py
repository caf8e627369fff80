"""What a trained run offers, whatever its method."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from mrgs.data import load_scene
from mrgs.errors import SceneError
from mrgs.render import Rendering
from mrgs.scene import Camera, Scene, TemperatureRange, View
from mrgs.training.checkpoint import CheckpointFacts, require_same_scene
from mrgs.training.run_folder import RunConfig, RunFolder


@dataclass(frozen=True, eq=False)
class TrainedRun(ABC):
    """A run's newest checkpoint, whatever its method; what scoring and rendering need.

    Attributes:
        folder: the run's folder.
        config: what it was trained with.
        facts: steps, scene, temperature scale, cost.
    """

    folder: RunFolder
    config: RunConfig
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
