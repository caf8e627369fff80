"""From what is there to what the cameras write: the loss compares photos with these images, nobody
else sees them.

None of this is in the paper. Each part undoes one thing that a camera does, so that the model need
not learn it: a thermal lens spreads every point, a detector's columns have offsets, exposure
changes from photo to photo, and the pose of a thermal camera is often known only roughly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mrgs.errors import ConfigError
from mrgs.method.camera_model.exposure import Exposure, Look, Setting
from mrgs.method.camera_model.point_spread import spread_points
from mrgs.render import Rendering
from mrgs.scene import Camera, Scene

INITIAL_POINT_SPREAD_PX = 0.8
SMALLEST_POINT_SPREAD_PX = 0.2

SMALL_ROTATION = 1e-2
"""Radians below which two terms of the series are as exact as float32."""


@dataclass(frozen=True)
class ImageModelConfig:
    """Which of the cameras' doings are modelled, and how fast they are learned; all off as
    published.

    Attributes:
        point_spread: blur the rendered temperatures by a Gaussian of learned width before they are
            compared.
        fixed_pattern: add a learned offset to each column and each row of the thermal images.
        exposure: a learned gain and offset of each photo's colours.
        thermal_gain: the same of each thermal photo, in scenes without °C: their cameras may scale
            every photo anew.
        thermal_poses: a learned motion of each thermal camera, where it is not the RGB camera.
        point_spread_rate: learning rate of the logarithm of the blur's width.
        fixed_pattern_rate: of the offsets, in normalised temperature.
        exposure_rate: of gains and offsets.
        thermal_poses_rate: of the motions, in radians and scene extents.
    """

    point_spread: bool = False
    fixed_pattern: bool = False
    exposure: bool = False
    thermal_gain: bool = False
    thermal_poses: bool = False
    point_spread_rate: float = 5e-3
    fixed_pattern_rate: float = 1e-4
    exposure_rate: float = 1e-3
    thermal_poses_rate: float = 5e-4

    def __post_init__(self) -> None:
        for name in (
            "point_spread_rate",
            "fixed_pattern_rate",
            "exposure_rate",
            "thermal_poses_rate",
        ):
            if not 0 <= getattr(self, name) < math.inf:
                raise ConfigError(
                    f"the learning rate {name} must be 0 or more, not {getattr(self, name)}"
                )


class Capture(NamedTuple):
    """What the image model must know of a scene's photos.

    Attributes:
        rgb_looks: of each training view's first camera, None where the view has no RGB photo.
        thermal_looks: the same, None where it has no thermal photo.
        thermal_size: width and height of the thermal photos in pixels; None if they differ, or if
            there are none.
        extent: of the scene.
        has_celsius: whether the values of the thermal photos are temperatures.
    """

    rgb_looks: tuple[Look | None, ...]
    thermal_looks: tuple[Look | None, ...]
    thermal_size: tuple[int, int] | None
    extent: float
    has_celsius: bool

    @classmethod
    def of(cls, scene: Scene) -> Capture:
        """That of a scene's training views."""
        sizes = {
            (view.thermal.camera.width, view.thermal.camera.height)
            for view in scene.train
            if view.thermal
        }
        extent = scene.extent
        looks = [Look.of(camera, extent) for camera in scene.train_cameras]
        pairs = list(zip(looks, scene.train, strict=True))
        return cls(
            tuple(look if view.rgb else None for look, view in pairs),
            tuple(look if view.thermal else None for look, view in pairs),
            sizes.pop() if len(sizes) == 1 else None,
            extent,
            scene.temperature is not None,
        )

    @property
    def lacks_celsius(self) -> bool:
        """Whether there are thermal photos whose values are no temperatures: they may be scaled by
        themselves."""
        return any(self.thermal_looks) and not self.has_celsius

    @property
    def views(self) -> int:
        """Number of training views."""
        return len(self.rgb_looks)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Capture:
        """From what ``_asdict`` gave to a JSON file; KeyError, TypeError or ValueError where it is
        something else."""
        size = values["thermal_size"]
        if size is not None:
            width, height = size
            size = (int(width), int(height))
        rgb, thermal = (
            tuple(None if look is None else Look.from_json(look) for look in values[name])
            for name in ("rgb_looks", "thermal_looks")
        )
        return cls(rgb, thermal, size, float(values["extent"]), bool(values["has_celsius"]))


class PointSpread(nn.Module):
    """A Gaussian point spread whose width is learned; what lies beyond the frame is left out of the
    mean."""

    def __init__(self) -> None:
        super().__init__()
        self.log_sigma = nn.Parameter(torch.tensor(math.log(INITIAL_POINT_SPREAD_PX)))

    @property
    def sigma_px(self) -> Float[Tensor, ""]:
        """Standard deviation in pixels of the thermal image."""
        return self.log_sigma.exp().clamp_min(SMALLEST_POINT_SPREAD_PX)

    def forward(self, image: Float[Tensor, "h w 1"]) -> Float[Tensor, "h w 1"]:
        """The image as the lens and the detector spread it."""
        return spread_points(image[:, :, 0], self.sigma_px)[:, :, None]


class FixedPattern(nn.Module):
    """Offsets of the detector's columns and rows, the same in every photo, in normalised
    temperature; mean 0."""

    def __init__(self, size: tuple[int, int]) -> None:
        super().__init__()
        width, height = size
        self.columns = nn.Parameter(torch.zeros(width))
        self.rows = nn.Parameter(torch.zeros(height))

    def forward(self, image: Float[Tensor, "h w 1"]) -> Float[Tensor, "h w 1"]:
        """The image with the offsets."""
        columns, rows = self.columns - self.columns.mean(), self.rows - self.rows.mean()
        return image + (columns + rows[:, None])[:, :, None]


class ThermalPoses(nn.Module):
    """A small motion of each thermal camera: a rotation vector and a translation in its own
    axes."""

    def __init__(self, views: int, extent: float) -> None:
        super().__init__()
        self.twists = nn.ParameterList([nn.Parameter(torch.zeros(6)) for _ in range(views)])
        self._extent = extent

    def forward(self, view: int) -> Float[Tensor, "4 4"]:
        """From the camera's axes as given to its axes as found."""
        twist = self.twists[view]
        return torch.cat(
            [
                torch.cat([_rotation(twist[:3]), self._extent * twist[3:, None]], dim=1),
                torch.eye(4, dtype=twist.dtype, device=twist.device)[3:],
            ]
        )


def _rotation(vector: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The rotation by a rotation vector."""
    x, y, z = vector
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    return (
        torch.linalg.matrix_exp(skew) if vector.device.type == "cpu" else _exponential(vector, skew)
    )


def _exponential(vector: Float[Tensor, "3"], skew: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """Rodrigues' formula; torch's matrix exponential makes the host wait for a GPU.

    I + sin θ/θ K + (1 − cos θ)/θ² K², with the series about θ = 0 where the quotients lose their
    digits.
    """
    squared = (vector * vector).sum()
    is_small = squared < SMALL_ROTATION**2
    angle = torch.where(
        is_small, 1, squared
    ).sqrt()  # away from 0, where the root has no derivative
    first = torch.where(is_small, 1 - squared / 6, angle.sin() / angle)
    second = torch.where(is_small, 0.5 - squared / 24, 2 * ((0.5 * angle).sin() / angle) ** 2)
    return (
        torch.eye(3, dtype=vector.dtype, device=vector.device)
        + first * skew
        + second * (skew @ skew)
    )


class ImageModel(nn.Module):
    """All parts that are switched on and possible for a scene."""

    def __init__(self, config: ImageModelConfig, capture: Capture) -> None:
        super().__init__()
        self._config = config
        self.point_spread = PointSpread() if config.point_spread else None
        size = capture.thermal_size if config.fixed_pattern else None
        self.fixed_pattern = None if size is None else FixedPattern(size)
        self.exposure = (
            Exposure(capture.rgb_looks, 3) if config.exposure and any(capture.rgb_looks) else None
        )
        scaled_anew = config.thermal_gain and capture.lacks_celsius
        self.thermal_gain = Exposure(capture.thermal_looks, 1) if scaled_anew else None
        self.thermal_poses = (
            ThermalPoses(capture.views, capture.extent) if config.thermal_poses else None
        )
        self._extent = capture.extent

    def forward(self, rendering: Rendering, view: int) -> Rendering:
        """The rendering of a training view as its cameras would have written it."""
        return self._written(rendering, lambda exposure: exposure.of(view))

    @torch.no_grad()
    def expected(self, rendering: Rendering, camera: Camera) -> Rendering:
        """The rendering of any camera as it would have written it, as far as the training photos
        tell; no gradients."""
        look = Look.of(camera, self._extent)
        return self._written(rendering, lambda exposure: exposure.expected(look))

    def _written(self, rendering: Rendering, setting: Callable[[Exposure], Setting]) -> Rendering:
        rgb, thermal = rendering.rgb, rendering.thermal
        if rgb is not None and self.exposure is not None:
            rgb = setting(self.exposure).expose(rgb)
        if thermal is not None:
            if self.point_spread is not None:
                thermal = self.point_spread(thermal)
            if self.thermal_gain is not None:
                thermal = setting(self.thermal_gain).expose(thermal)
            if self.fixed_pattern is not None:
                thermal = self.fixed_pattern(thermal)
        return rendering._replace(rgb=rgb, thermal=thermal)

    def thermal_motion(self, view: int) -> Float[Tensor, "4 4"] | None:
        """The motion of a view's thermal camera; None where poses are taken as they are."""
        return None if self.thermal_poses is None else self.thermal_poses(view)

    def parameter_groups(self) -> list[dict]:
        """Groups for an optimizer, each with its learning rate."""
        rates = {
            "point_spread": self._config.point_spread_rate,
            "fixed_pattern": self._config.fixed_pattern_rate,
            "exposure": self._config.exposure_rate,
            "thermal_gain": self._config.exposure_rate,
            "thermal_poses": self._config.thermal_poses_rate,
        }
        parts = [(getattr(self, name), rate) for name, rate in rates.items()]
        return [
            {"params": list(part.parameters()), "lr": rate}
            for part, rate in parts
            if part is not None
        ]
