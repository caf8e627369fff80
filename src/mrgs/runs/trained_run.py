"""The interface of a trained run of any method."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mrgs.data import load_scene
from mrgs.errors import SceneError
from mrgs.run_files.facts import CheckpointFacts, require_same_scene
from mrgs.run_files.folder import RunConfig, RunFolder
from mrgs.scene import (
    NOT_COARSER,
    THERMAL,
    Array,
    Camera,
    Modality,
    Rendering,
    Scene,
    TemperatureRange,
    View,
)
from mrgs.scene.arrays import as_tensor
from mrgs.scene.depth_map import PhotoSurvey, before_background
from mrgs.scene.rendering import SOLID_ALPHA


@dataclass(frozen=True, eq=False, repr=False)
class TrainedRun(ABC):
    """A run's newest checkpoint, of any method: what scoring and rendering need. ``scene`` is that
    it was trained on, if it was given in memory; None to read it from its folder."""

    folder: RunFolder
    config: RunConfig
    facts: CheckpointFacts
    scene: Scene | None = field(default=None, kw_only=True)

    def __repr__(self) -> str:
        count = self.gaussian_count
        size = "" if count is None else f", {count:,} Gaussians"
        return f"{type(self).__name__}({self.config.method}, step {self.facts.step:,}{size})"

    @abstractmethod
    def render_cameras(self, cameras: Mapping[Modality, Camera]) -> Rendering:
        """Render each modality from its camera, without gradients."""

    @property
    @abstractmethod
    def modalities(self) -> tuple[Modality, ...]:
        """Modalities that the run renders: those of which its scene has photos."""

    @property
    @abstractmethod
    def gaussian_count(self) -> int | None:
        """How many Gaussians the model has; None if the method has none."""

    @property
    def temperature(self) -> TemperatureRange | None:
        """The scale of the thermal values; None if the scene has no known °C."""
        return self.facts.temperature

    def render(self, cameras: Camera | Mapping[Modality, Camera]) -> Rendering:
        """Render any camera, without gradients: one for all modalities of the model, or one for
        each modality to render, ``{RGB: ..., THERMAL: ...}``; with the emissivity of the photos,
        also in marked areas (``RunMarks.render`` has theirs). ValueError if ``cameras`` is
        something else, or asks for what the run does not render."""
        return self.render_cameras(asked_cameras(cameras, self.modalities))

    def render_view(self, view: View) -> Rendering:
        """Render a view from its own cameras, without gradients; the modalities that both have."""
        cameras = view.cameras
        return self.render_cameras(
            {each: cameras[each] for each in cameras if each in self.modalities}
        )

    def camera_response(
        self,
        rendering: Rendering,
        camera: Camera,
        pixel_sizes: Mapping[Modality, float] = NOT_COARSER,
    ) -> Rendering:
        """The rendering of a camera as the scene's cameras would have recorded it there, to be
        compared with photos: the same, unless the method has learned what the cameras do to the
        images. The pixel sizes are those of the images, in pixels of the photos; 1 by default."""
        return rendering

    def temperatures_c(
        self, rendering: Rendering, min_alpha: float = SOLID_ALPHA
    ) -> Float[Tensor, "h w"]:
        """The temperatures of a rendering of this run in °C, NaN where there is none, [H, W]. A
        pixel that the model covers less than ``min_alpha`` has none; 0 gives every pixel its value,
        which tends to the scene's lowest temperature where nothing is. ValueError if the scene has
        no known °C, or the rendering no thermal image."""
        if self.temperature is None or THERMAL not in rendering:
            raise ValueError(
                "no °C: the scene has no temperature range, or the rendering has no thermal image"
            )
        image, _, alpha = rendering[THERMAL]
        celsius = self.temperature.to_celsius(image[..., 0])
        return torch.where(alpha < min_alpha, torch.nan, celsius)

    def temperature_at(self, points: Array) -> Float[Tensor, " n"]:
        """Temperatures of points on surfaces, as the scene's thermal cameras see them in the model:
        °C, [N], of points in world coordinates, scene units, [N, 3]; NaN for a point that no camera
        sees on a surface.

        A point counts as seen by a camera where the rendered surface lies within 3 % of its depth:
        points behind a surface, in the air or on an outline are not. The value is the mean over the
        cameras that see it, nearer ones weighing more, with the emissivity of the photos
        (``RunMarks.temperature_at`` has that of marked areas). A camera is rendered when a
        point in its image is first asked for; of more than 64, those that suffice for every place.

        ValueError if the scene has no thermal photos to learn from or no known °C, or ``points``
        has another shape; SceneError if the scene is no longer where it was, or cannot be used."""
        positions = as_tensor(points, torch.float32, (None, 3), "points").numpy()
        survey = self._photo_survey
        if self.temperature is None:
            raise ValueError("no °C: the scene has no temperature range")
        return self.temperature.to_celsius(torch.from_numpy(survey.temperatures(positions)))

    @cached_property
    def _photo_survey(self) -> PhotoSurvey:
        """What the scene's thermal cameras see of the model."""
        scene = self.load_scene()
        cameras = scene.survey_cameras(THERMAL)
        if not cameras:
            raise ValueError("no °C: the scene has no thermal photos to learn from")
        return PhotoSurvey(before_background(self.render, scene.reach), cameras)

    def load_scene(self) -> Scene:
        """The scene that the run was trained on, at the run's resolution. SceneError if the scene
        is no longer where it was, or cannot be used; RunError if the scene has other cameras or
        another temperature range than the run was trained with."""
        if self.scene is not None:
            require_same_scene(self.facts, self.scene)
            return self.scene
        path, run = self.facts.scene, self.folder.path
        if not path or not Path(path).exists():
            problem = (
                f"{path}: the scene that {run} was trained on is no longer there; say where it is"
            )
            if not path:
                problem = f"{run} was trained on a scene made from arrays: open it with that scene"
            raise SceneError(problem, options=("scene",))
        scene = load_scene(path, resolution=self.config.resolution, seed=self.config.seed)
        require_same_scene(self.facts, scene)
        return scene


def asked_cameras(
    cameras: Camera | Mapping[Modality, Camera], modalities: Iterable[Modality]
) -> Mapping[Modality, Camera]:
    """The camera of each modality to render: the given one for all that can be rendered, or one for
    each. ValueError for anything else, or a modality that cannot be rendered."""
    modalities = tuple(modalities)
    if isinstance(cameras, Camera):
        return dict.fromkeys(modalities, cameras)
    if not isinstance(cameras, Mapping):
        raise ValueError(
            f"cameras must be a Camera or a mapping such as {{RGB: camera}}, not "
            f"{type(cameras).__name__}"
        )
    names = " and ".join(map(str, modalities))
    if not cameras:
        raise ValueError(f"cameras is empty: give a Camera, or one for each of {names}")
    for modality, camera in cameras.items():
        if not isinstance(modality, Modality):
            raise ValueError(f"{modality!r} is not a modality: use mrgs.RGB or mrgs.THERMAL")
        if modality not in modalities:
            raise ValueError(f"{modality} cannot be rendered here, only {names}: leave it out")
        if not isinstance(camera, Camera):
            raise ValueError(f"{modality} must have a Camera, not {type(camera).__name__}")
    return cameras
