"""What a model needs to know of the photos of its scene."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from mrgs.scene.camera import Camera
from mrgs.scene.modality import RGB, THERMAL, Modality, in_order
from mrgs.scene.scene import Scene


class Viewpoint(NamedTuple):
    """Position and viewing direction of a camera, in world coordinates.

    Attributes:
        position: of the camera, in scene extents.
        forward: viewing direction, unit length.
    """

    position: tuple[float, float, float]
    forward: tuple[float, float, float]

    @classmethod
    def of(cls, camera: Camera, extent: float) -> Viewpoint:
        """The viewpoint of a camera in a scene of this extent."""
        return cls(_triple((camera.position / extent).tolist()), _triple(camera.forward.tolist()))

    @classmethod
    def from_json(cls, values: Any) -> Viewpoint:
        """A viewpoint from its JSON form.

        Raises:
            TypeError, ValueError: the values are no viewpoint.
        """
        position, forward = values
        viewpoint = cls(_triple(position), _triple(forward))
        if not all(map(math.isfinite, (*viewpoint.position, *viewpoint.forward))):
            raise ValueError("a viewpoint must be finite")
        return viewpoint


class Capture(NamedTuple):
    """What a model needs to know of a scene's training views.

    Attributes:
        thermal_viewpoints: of each training view's camera, None where it has no thermal photo.
        extent: of the scene.
        has_celsius: whether the values of the thermal photos are temperatures.
        finest_focal_px: median focal length, in pixels, of the modality whose photos are finest;
            None in the checkpoints of older versions.
    """

    thermal_viewpoints: tuple[Viewpoint | None, ...]
    extent: float
    has_celsius: bool
    finest_focal_px: float | None = None

    @classmethod
    def of(cls, scene: Scene) -> Capture:
        """The capture of a scene's training views."""
        extent = scene.extent
        return cls(
            tuple(
                Viewpoint.of(camera, extent) if THERMAL in view.images else None
                for camera, view in zip(scene.train_cameras, scene.train, strict=True)
            ),
            extent,
            scene.temperature is not None,
            _finest_focal_px(scene),
        )

    @property
    def lacks_celsius(self) -> bool:
        """Whether there are thermal photos whose values are no temperatures."""
        return any(self.thermal_viewpoints) and not self.has_celsius

    @property
    def may_drift(self) -> bool:
        """Whether there are thermal photos in °C."""
        return any(self.thermal_viewpoints) and self.has_celsius

    @property
    def views(self) -> int:
        """Number of training views."""
        return len(self.thermal_viewpoints)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Capture:
        """A capture from the JSON form of ``_asdict``.

        Raises:
            KeyError, TypeError, ValueError: the values are no capture.
        """
        viewpoints = tuple(
            None if point is None else Viewpoint.from_json(point)
            for point in values["thermal_viewpoints"]
        )
        extent = float(values["extent"])
        if not 0 < extent < math.inf:
            raise ValueError("the extent is a length")
        finest = values.get("finest_focal_px")
        finest = None if finest is None else float(finest)
        if finest is not None and not 0 < finest < math.inf:
            raise ValueError("the focal length is a number of pixels")
        return cls(viewpoints, extent, bool(values["has_celsius"]), finest)


def _finest_focal_px(scene: Scene) -> float:
    """The largest of the modalities' median focal lengths: one zoomed photo makes none finer."""
    photos = [scene.train_photos(modality) for modality in scene.modalities]
    return max(statistics.median(photo.camera.focal_px for photo in own) for own in photos if own)


def model_modalities(captured: Iterable[Modality]) -> tuple[Modality, ...]:
    """What a model renders: RGB and thermal always, others where there are photos.

    Args:
        captured: the scene's modalities.
    """
    return in_order((RGB, THERMAL, *captured))


def _triple(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z
