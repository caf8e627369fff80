"""What cameras do to an image; the loss compares photos with renderings to which it was applied.

None of this is in the paper. Each part undoes one effect, so that the Gaussians need not learn it:
a thermal lens blurs, and automatic gain scales each photo differently.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from mrgs.method.adam import ParameterGroup
from mrgs.method.camera_model.photo_drift import PhotoDrift, residual_of
from mrgs.method.camera_model.photo_gain import Gain, PhotoGain
from mrgs.method.camera_model.point_spread import blur
from mrgs.method.camera_model.pose_refinement import PoseRefinement
from mrgs.scene import NOT_COARSER, THERMAL, Camera, Modality, Pixels, Rendering
from mrgs.scene.capture import Capture, Viewpoint
from mrgs.system.limits import MOST_RATE, require_within

INITIAL_POINT_SPREAD_PX = 0.8
SMALLEST_POINT_SPREAD_PX = 0.2
"""In pixels of a rendering, which may be coarser than the photo."""

SMALLEST_LEARNED_PX = 0.3
"""In pixels of the photo. It moves a hundredth of what a pixel shows to its neighbours; a much
smaller width has no gradient, so that it would never grow again."""


@dataclass(frozen=True)
class ImageModelConfig:
    """Which camera effects are modelled, and their learning rates; all off as published.

    Attributes:
        point_spread: blur the rendered temperatures by a Gaussian of learned width.
        thermal_gain: a learned gain and offset per thermal photo, in scenes without °C, whose
            cameras may have automatic gain.
        thermal_drift: an offset per thermal photo, in scenes with °C, see ``PhotoDrift``.
        poses: refine the poses of the training views if they turn out to be wrong, see
            ``PoseRefinement``.
        point_spread_rate: learning rate of the logarithm of the blur's width.
        thermal_gain_rate: learning rate of gains and offsets.
        poses_rate: learning rate of the poses, in focal lengths.
    """

    point_spread: bool = False
    thermal_gain: bool = False
    thermal_drift: bool = False
    poses: bool = False
    point_spread_rate: float = 5e-3
    thermal_gain_rate: float = 1e-3
    poses_rate: float = 1e-4

    def __post_init__(self) -> None:
        names = ("point_spread_rate", "thermal_gain_rate", "poses_rate")
        require_within(self, names, 0, MOST_RATE, "the learning rate {}")

    def faster(self, factor: float) -> ImageModelConfig:
        """All learning rates times a factor."""
        return replace(
            self,
            point_spread_rate=factor * self.point_spread_rate,
            thermal_gain_rate=factor * self.thermal_gain_rate,
            poses_rate=factor * self.poses_rate,
        )


class PointSpread(nn.Module):
    """A Gaussian point spread whose width is learned; what lies beyond the frame is left out of the
    mean."""

    def __init__(self) -> None:
        super().__init__()
        self.log_sigma = nn.Parameter(torch.tensor(math.log(INITIAL_POINT_SPREAD_PX)))

    @property
    def sigma_px(self) -> Float[Tensor, ""]:
        """Standard deviation in pixels of the thermal image."""
        return self.log_sigma.exp()

    def forward(
        self, image: Float[Tensor, "h w 1"], pixel_size: float = 1.0
    ) -> Float[Tensor, "h w 1"]:
        """The image as the lens and the detector spread it.

        Args:
            image: the rendered temperatures.
            pixel_size: of the image, in pixels of the photos.
        """
        sigma = (self.sigma_px / pixel_size).clamp_min(SMALLEST_POINT_SPREAD_PX)
        return blur(image[:, :, 0], sigma)[:, :, None]

    @torch.no_grad()
    def limit(self) -> None:
        """Widen the spread to ``SMALLEST_LEARNED_PX`` if it is narrower."""
        self.log_sigma.clamp_(min=math.log(SMALLEST_LEARNED_PX))


class ImageModel(nn.Module):
    """Every camera effect that the configuration enables and the scene has."""

    def __init__(self, config: ImageModelConfig, capture: Capture) -> None:
        super().__init__()
        self._config = config
        self.point_spread = PointSpread() if config.point_spread else None
        has_gain = config.thermal_gain and capture.lacks_celsius
        self.thermal_gain = PhotoGain(capture.thermal_viewpoints) if has_gain else None
        has_drift = config.thermal_drift and capture.may_drift
        self.thermal_drift = PhotoDrift(capture.thermal_viewpoints) if has_drift else None
        self.poses = PoseRefinement(capture.views) if config.poses else None
        self._extent = capture.extent

    def refined(
        self, cameras: Mapping[Modality, Camera], view: Int64[Tensor, "1"]
    ) -> Mapping[Modality, Camera]:
        """The cameras of a training view where they are taken to have been.

        Args:
            cameras: of the view.
            view: its place among the training views, on the model's device.
        """
        if not self.moves_poses:
            return cameras
        assert self.poses is not None
        return self.poses.refined(cameras, view)

    @property
    def moves_poses(self) -> bool:
        """Whether the poses of the training views are refined by now; a GPU is not asked."""
        return self.poses is not None and self.poses.moves

    def forward(
        self,
        rendering: Rendering,
        view: Int64[Tensor, "1"],
        pixel_sizes: Mapping[Modality, float] = NOT_COARSER,
    ) -> Rendering:
        """The rendering of a training view as its cameras write it.

        Args:
            rendering: of the view.
            view: its place among the training views, on the rendering's device.
            pixel_sizes: of the rendering's images, in pixels of the photos; 1 where none is given.
        """
        return self._written(
            rendering,
            lambda gains: gains.of(view),
            lambda drift: drift.of(view),
            pixel_sizes.get(THERMAL, 1.0),
        )

    @torch.no_grad()
    def expected(
        self,
        rendering: Rendering,
        camera: Camera,
        pixel_sizes: Mapping[Modality, float] = NOT_COARSER,
    ) -> Rendering:
        """The rendering of any camera as it is expected to write it, a ``CameraResponse``; no
        gradients."""
        viewpoint = Viewpoint.of(camera, self._extent)
        return self._written(
            rendering,
            lambda gains: gains.expected(viewpoint),
            lambda drift: drift.expected(viewpoint),
            pixel_sizes.get(THERMAL, 1.0),
        )

    def thermal_residual(
        self, view: Int64[Tensor, "1"], written: Rendering, photo: Pixels
    ) -> Float[Tensor, "2"] | None:
        """How far a training photo lies above the model, for ``learn_drift``; None where drift is
        not modelled.

        Args:
            view: whose photo it is.
            written: what ``forward`` returned for it.
            photo: its thermal photo.
        """
        if self.thermal_drift is None:
            return None
        offset = self.thermal_drift.of(view)
        residual = (photo.values - written[THERMAL].image.detach() + offset)[:, :, 0]
        if photo.valid is not None:
            residual = torch.where(photo.valid, residual, torch.nan)
        return residual_of(residual)

    def learn_drift(
        self, view: int, residual: Float[Tensor, "2"], finite: Bool[Tensor, ""]
    ) -> None:
        """Take in how far a training photo lies above the model.

        Args:
            view: whose photo it is.
            residual: what ``thermal_residual`` returned for it.
            finite: nothing is learned where it is False.
        """
        assert self.thermal_drift is not None
        self.thermal_drift.learn(view, residual, finite)

    def limit(self) -> None:
        """Bring parameters that an optimizer has moved too far back to where they have a
        gradient."""
        if self.point_spread is not None:
            self.point_spread.limit()

    def _written(
        self,
        rendering: Rendering,
        gain: Callable[[PhotoGain], Gain],
        offset: Callable[[PhotoDrift], Tensor],
        pixel_size: float = 1.0,
    ) -> Rendering:
        if THERMAL not in rendering:
            return rendering
        thermal = rendering[THERMAL].image
        if self.point_spread is not None:
            thermal = self.point_spread(thermal, pixel_size)
        if self.thermal_gain is not None:
            thermal = gain(self.thermal_gain).apply(thermal)
        if self.thermal_drift is not None:
            thermal = thermal + offset(self.thermal_drift)
        return rendering.with_images({THERMAL: thermal})

    def parameter_groups(self) -> list[ParameterGroup]:
        """Groups for an optimizer, each with its learning rate."""
        parts = [
            (self.point_spread, self._config.point_spread_rate),
            (self.thermal_gain, self._config.thermal_gain_rate),
            (self.poses, self._config.poses_rate),
        ]
        return [
            ParameterGroup(list(part.parameters()), rate)
            for part, rate in parts
            if part is not None
        ]
