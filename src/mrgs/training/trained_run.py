"""The interface of a trained run of any method."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from mrgs.data import load_scene
from mrgs.errors import SceneError
from mrgs.scene import THERMAL, Camera, Modality, Rendering, Scene, TemperatureRange, View
from mrgs.training.checkpoint import CheckpointFacts, require_same_scene
from mrgs.training.run_folder import RunConfig, RunFolder


@dataclass(frozen=True, eq=False)
class TrainedRun(ABC):
    """A run's newest checkpoint, of any method: what scoring and rendering need.

    Attributes:
        folder: the run's folder.
        config: what it was trained with.
        facts: steps, scene, temperature scale, cost.
    """

    folder: RunFolder
    config: RunConfig
    facts: CheckpointFacts

    @abstractmethod
    def render_cameras(self, cameras: Mapping[Modality, Camera]) -> Rendering:
        """Render each modality from its camera, without gradients."""

    @property
    @abstractmethod
    def modalities(self) -> tuple[Modality, ...]:
        """Modalities that the model renders."""

    @property
    @abstractmethod
    def gaussian_count(self) -> int | None:
        """How many Gaussians the model has; None if the method has none."""

    @property
    def temperature(self) -> TemperatureRange | None:
        """The scale of the thermal values; None if the scene has no known °C."""
        return self.facts.temperature

    def render(self, cameras: Camera | Mapping[Modality, Camera]) -> Rendering:
        """Render any camera, without gradients.

        Args:
            cameras: one for all modalities of the model, or one for each modality to render:
                ``{RGB: ..., THERMAL: ...}``.
        """
        if isinstance(cameras, Camera):
            cameras = dict.fromkeys(self.modalities, cameras)
        return self.render_cameras(cameras)

    def render_view(self, view: View) -> Rendering:
        """Render a view from its own cameras, without gradients; the modalities that both have."""
        cameras = view.cameras
        return self.render_cameras(
            {each: cameras[each] for each in cameras if each in self.modalities}
        )

    def camera_response(self, rendering: Rendering, camera: Camera) -> Rendering:
        """The rendering of a camera as the scene's cameras would have recorded it there, to be
        compared with photos.

        The same, unless the method has learned what the cameras do to the images.
        """
        return rendering

    def temperatures_c(self, rendering: Rendering) -> Float[Tensor, "h w"]:
        """The rendered temperatures in °C.

        Raises:
            ValueError: the scene has no known °C, or the rendering no thermal image.
        """
        if self.temperature is None or THERMAL not in rendering:
            raise ValueError(
                "no °C: the scene has no temperature range, or the rendering has no thermal image"
            )
        return self.temperature.to_celsius(rendering[THERMAL].image[..., 0])

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
                f"longer there; say where it is",
                options=("scene",),
            )
        scene = load_scene(
            self.facts.scene, resolution=self.config.resolution, seed=self.config.seed
        )
        require_same_scene(self.facts, scene)
        return scene
