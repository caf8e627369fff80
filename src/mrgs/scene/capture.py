"""What a model needs to know of the photos of its scene."""

from __future__ import annotations

import statistics
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple, TypeAlias

import msgspec
import torch
from jaxtyping import Float64
from torch import Tensor

from mrgs.scene.air import AirPath
from mrgs.scene.camera import Camera
from mrgs.scene.modality import RGB, THERMAL, Modality, in_order
from mrgs.scene.radiometry import BandRadiance, law_of
from mrgs.scene.scene import Scene
from mrgs.scene.view import View
from mrgs.system.typed_json import Finite

Length: TypeAlias = Annotated[float, msgspec.Meta(gt=0, le=sys.float_info.max)]


class Viewpoint(NamedTuple):
    """A camera's position, in scene extents, and unit viewing direction, in world coordinates."""

    position: tuple[Finite, Finite, Finite]
    forward: tuple[Finite, Finite, Finite]

    @classmethod
    def of(cls, camera: Camera, extent: float) -> Viewpoint:
        """The viewpoint of a camera in a scene of this extent."""
        return cls(tuple((camera.position / extent).tolist()), tuple(camera.forward.tolist()))


def moved_viewpoints(
    viewpoints: Sequence[Viewpoint], motions: Float64[Tensor, "n 4 4"], extent: float
) -> list[Viewpoint]:
    """The viewpoints of N cameras after ``Camera.moved``, by motions in scene units."""
    positions, directions = motions.new_tensor(viewpoints).unbind(1)
    positions = positions - motions[:, :3, 3] / extent
    back = torch.stack([positions, directions], dim=1) @ motions[:, :3, :3]
    return [Viewpoint(tuple(position), tuple(forward)) for position, forward in back.tolist()]


@dataclass(frozen=True)
class Capture:
    """What a model needs to know of a scene's training views.

    Attributes:
        thermal_viewpoints: of each training view's camera, None where it has no thermal photo.
        has_celsius: whether the values of the thermal photos are temperatures.
        finest_focal_px: median focal length, in pixels, of the modality with the finest photos: one
            zoomed photo makes none finer. None in the checkpoints of older versions.
        minutes: when each training view's thermal photo was taken, since the first photo of the
            scene; None where it has none, or that is not known.
        held_out: viewpoint and time of the held-out thermal photos, where that is known.
        radiance: what the pixels of the thermal photos average; None without °C, and in the
            checkpoints of older versions.
        air: between camera and objects; None where the photos do not say for which distance their
            temperatures were computed, or the scene has no metres.
    """

    thermal_viewpoints: tuple[Viewpoint | None, ...]
    extent: Length
    has_celsius: bool
    finest_focal_px: Length | None = None
    minutes: tuple[Finite | None, ...] = ()
    held_out: tuple[tuple[Viewpoint, Finite], ...] = ()
    radiance: BandRadiance | None = None
    air: AirPath | None = None

    @classmethod
    def of(cls, scene: Scene) -> Capture:
        """The capture of a scene's training views."""
        extent = scene.extent
        focal_px = [
            [photo.camera.focal_px for photo in scene.train_photos(modality)]
            for modality in scene.modalities
        ]
        first = min((each.taken for each in scene.records if each.taken), default=None)

        def minutes(view: View) -> float | None:
            record = view.images[THERMAL].record if THERMAL in view.images else None
            if first is None or record is None or record.taken is None:
                return None
            return (record.taken - first).total_seconds() / 60

        radiance = BandRadiance.of(scene.temperature, law_of(scene.records))
        held_out = ((Viewpoint.of(view.camera, extent), minutes(view)) for view in scene.eval)
        return cls(
            tuple(
                Viewpoint.of(camera, extent) if THERMAL in view.images else None
                for camera, view in zip(scene.train_cameras, scene.train, strict=True)
            ),
            extent,
            scene.temperature is not None,
            max(statistics.median(own) for own in focal_px if own),
            tuple(map(minutes, scene.train)),
            tuple((viewpoint, when) for viewpoint, when in held_out if when is not None),
            radiance,
            AirPath.of(scene.records, radiance, scene.reach.background_begins)
            if scene.world.metric
            else None,
        )

    @property
    def lacks_celsius(self) -> bool:
        """Whether there are thermal photos whose values are not temperatures."""
        return any(self.thermal_viewpoints) and not self.has_celsius

    @property
    def may_drift(self) -> bool:
        """Whether there are thermal photos in °C."""
        return any(self.thermal_viewpoints) and self.has_celsius

    @property
    def views(self) -> int:
        """Number of training views."""
        return len(self.thermal_viewpoints)


def model_modalities(captured: Iterable[Modality]) -> tuple[Modality, ...]:
    """What a model renders: RGB and thermal always, others where there are photos."""
    return in_order((RGB, THERMAL, *captured))
