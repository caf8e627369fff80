"""What cameras do to an image: the loss compares photos with renderings to which it was applied, so
that the Gaussians need not learn it. Not in the paper. A thermal lens blurs and shades, automatic
gain scales each photo differently, a detector drifts, and poses may be off."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from mrgs.method.adam import ParameterGroup
from mrgs.method.camera_model.photo_drift import PhotoDrift, part_medians
from mrgs.method.camera_model.photo_gain import PhotoGain, only_one_at, viewpoint_distances
from mrgs.method.camera_model.photo_shading import PhotoShading
from mrgs.method.camera_model.point_spread import PointSpread
from mrgs.method.camera_model.pose_refinement import PoseRefinement
from mrgs.scene import NOT_COARSER, THERMAL, Camera, Modality, Pixels, Rendering
from mrgs.scene.capture import Capture, Viewpoint, moved_viewpoints
from mrgs.system.strict_yaml import MOST_RATE, require_within

_RATES = ("point_spread_rate", "thermal_gain_rate", "poses_rate")


@dataclass(frozen=True)
class ImageModelConfig:
    """Which camera effects are modelled, and their learning rates; all off as published.

    Attributes:
        radiance: blend and blur band radiance rather than temperatures, in scenes with °C.
        air: what the air between camera and object changes, by the rendered depth, in scenes with
            metres whose photos state their parameters, see ``AirPath``; needs ``radiance``.
        point_spread: blur the rendered temperatures by a Gaussian of learned width.
        thermal_gain: a learned gain and offset per thermal photo, in scenes without °C, whose
            cameras may have automatic gain.
        thermal_drift: an offset per thermal photo, in scenes with °C, see ``PhotoDrift``.
        thermal_shading: an addend common to all thermal photos, brighter or darker towards the
            corners, in scenes with °C, see ``PhotoShading``.
        flat_field: folder of thermal photos of a uniform target, which fix that shading; None to
            find it where the photos overlap.
        flat_field_unit: of the numbers in its files, such as ``(celsius+100)*40``; None where they
            say it.
        poses: refine the poses of the training views if they turn out to be wrong, see
            ``PoseRefinement``.
        point_spread_rate: learning rate of the logarithm of the blur's width.
        thermal_gain_rate: learning rate of gains and offsets.
        poses_rate: learning rate of the poses, in focal lengths.
    """

    radiance: bool = False
    air: bool = False
    point_spread: bool = False
    thermal_gain: bool = False
    thermal_drift: bool = False
    thermal_shading: bool = False
    flat_field: str | None = None
    flat_field_unit: str | None = None
    poses: bool = False
    point_spread_rate: float = 5e-3
    thermal_gain_rate: float = 1e-3
    poses_rate: float = 1e-4

    def __post_init__(self) -> None:
        require_within(self, _RATES, 0, MOST_RATE, "the learning rate {}")

    def faster(self, factor: float) -> ImageModelConfig:
        """All learning rates times a factor."""
        return replace(self, **{name: factor * getattr(self, name) for name in _RATES})


class ImageModel(nn.Module):
    """Every camera effect that the configuration enables and the scene has; None for the others.

    Attributes:
        air: between the camera and what it sees.
        point_spread: the blur of the thermal images.
        thermal_gain: gain and offset of each thermal photo.
        thermal_drift: offset of each thermal photo.
        thermal_shading: what all thermal photos have in common.
        poses: motions of the training views.
        constant: what the thermal photos show too little, all of them, by a reference temperature;
            normalised.
    """

    constant: Float[Tensor, ""]

    def __init__(self, config: ImageModelConfig, capture: Capture) -> None:
        super().__init__()
        self._config = config
        self.point_spread = PointSpread() if config.point_spread else None
        has_gain = config.thermal_gain and capture.lacks_celsius
        self.thermal_gain = PhotoGain(capture.thermal_viewpoints) if has_gain else None
        has_drift = config.thermal_drift and capture.may_drift
        times = capture.thermal_viewpoints, capture.minutes, capture.held_out
        self.thermal_drift = PhotoDrift(*times) if has_drift else None
        has_shading = config.thermal_shading and capture.may_drift
        photos = sum(point is not None for point in capture.thermal_viewpoints)
        shading = PhotoShading(photos, fixed=config.flat_field is not None)
        self.thermal_shading = shading if has_shading else None
        self.poses = PoseRefinement(capture.views) if config.poses else None
        self._radiance = capture.radiance if config.radiance else None
        self.air = capture.air if config.air and self._radiance is not None else None
        self.register_buffer("constant", torch.zeros(()))
        self._extent, self._viewpoints = capture.extent, capture.thermal_viewpoints

    @property
    def moves_poses(self) -> bool:
        """Whether the poses of the training views are refined by now; a GPU is not asked."""
        return self.poses is not None and self.poses.moves

    def refined(
        self, cameras: Mapping[Modality, Camera], view: Int64[Tensor, "1"]
    ) -> Mapping[Modality, Camera]:
        """The cameras of a training view at their refined pose. ``view`` is its place among the
        training views, on the model's device."""
        if self.poses is None or not self.poses.moves:
            return cameras
        return self.poses.refined(cameras, view)

    def forward(
        self,
        rendering: Rendering,
        view: Int64[Tensor, "1"],
        pixel_sizes: Mapping[Modality, float] = NOT_COARSER,
    ) -> Rendering:
        """The rendering of a training view as its cameras record it.

        Args:
            view: its place among the training views, on the rendering's device.
            pixel_sizes: of the rendering's images, in pixels of the photos; 1 where none is given.
        """
        return self._recorded(rendering, lambda effect: effect.of(view), pixel_sizes)

    @torch.no_grad()
    def expected(
        self,
        rendering: Rendering,
        camera: Camera,
        pixel_sizes: Mapping[Modality, float] = NOT_COARSER,
    ) -> Rendering:
        """The rendering of any camera as it records it, a ``CameraResponse``; no gradients."""
        viewpoint = self._as_given(Viewpoint.of(camera, self._extent))
        return self._recorded(rendering, lambda effect: effect.expected(viewpoint), pixel_sizes)

    def _as_given(self, viewpoint: Viewpoint) -> Viewpoint:
        """A training view's viewpoint before its pose was refined, if this is it now: by that the
        effects know their photos."""
        if self.poses is None or not self.poses.moves:
            return viewpoint
        views = [view for view, each in enumerate(self._viewpoints) if each is not None]
        given = [each for each in self._viewpoints if each is not None]
        if not given:
            return viewpoint
        now = moved_viewpoints(given, self.poses.all_motions()[views], self._extent)
        same = only_one_at(viewpoint_distances([viewpoint], now)[0])
        return viewpoint if same is None else given[same]

    def thermal_residual(self, recorded: Rendering, photo: Pixels) -> Float[Tensor, " n"] | None:
        """How far the parts of a training view's thermal photo are above the model, for ``learn``;
        None where nothing is learned from it. ``recorded`` is what ``forward`` returned."""
        if self.thermal_drift is None and self.thermal_shading is None:
            return None
        return part_medians(recorded[THERMAL].image.detach(), photo)

    def learn(self, view: int, residual: Float[Tensor, " n"], finite: Bool[Tensor, ""]) -> None:
        """Take in the ``thermal_residual`` of a training view, unless ``finite`` is False."""
        if self.thermal_shading is not None:
            self.thermal_shading.learn(residual - residual.nanmedian(), finite)
        if self.thermal_drift is not None:
            self.thermal_drift.learn(view, residual, finite)

    def limit(self) -> None:
        """Bring parameters that an optimizer moved too far back to where they have a gradient."""
        if self.point_spread is not None:
            self.point_spread.limit()

    def parameter_groups(self) -> list[ParameterGroup]:
        """Groups for an optimizer, each with its learning rate."""
        parts = (self.point_spread, self.thermal_gain, self.poses)
        return [
            ParameterGroup(list(part.parameters()), getattr(self._config, rate))
            for part, rate in zip(parts, _RATES, strict=True)
            if part is not None
        ]

    def _recorded(
        self,
        rendering: Rendering,
        value: Callable[[Any], Any],
        pixel_sizes: Mapping[Modality, float],
    ) -> Rendering:
        """The rendering with air and blur, and with the value of each effect of a photo."""
        if THERMAL not in rendering:
            return rendering
        thermal, radiance = rendering[THERMAL].image, self._radiance
        if self.point_spread is not None or self.air is not None:
            received = thermal if radiance is None else radiance.of_value(thermal)
            if self.air is not None:
                received = self.air.received(received, rendering[THERMAL])
            if self.point_spread is not None:
                received = self.point_spread(received, pixel_sizes.get(THERMAL, 1.0))
            thermal = received if radiance is None else radiance.to_value(received)
        if self.thermal_gain is not None:
            thermal = value(self.thermal_gain).apply(thermal)
        if self.thermal_drift is not None:
            thermal = thermal + value(self.thermal_drift)
        if self.thermal_shading is not None:
            thermal = thermal + self.thermal_shading(*thermal.shape[:2])
        thermal = thermal - self.constant
        return rendering.with_images({THERMAL: thermal})
