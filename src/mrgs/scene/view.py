"""A view: one shot, an RGB image and a thermal image, each with its own camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from torch import Tensor

from mrgs.scene.camera import Camera


@dataclass(frozen=True, eq=False)
class Pixels:
    """A decoded image.

    Attributes:
        values: [H, W, C]; RGB in [0, 1] (C = 3), or normalised temperature (C = 1).
        valid: [H, W], False where a pixel must be ignored (masked, or not seen by the lens); None
            if all count.
    """

    values: Float32[Tensor, "h w c"]
    valid: Bool[Tensor, "h w"] | None = None


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image that is read when it is needed.

    Attributes:
        camera: the pinhole camera of the pixels that ``load`` returns.
        load: reads, undistorts and resizes the image; may raise SceneError. Reading twice gives the
            same bits.
    """

    camera: Camera
    load: Callable[[], Pixels]


@dataclass(frozen=True, eq=False)
class View:
    """One shot. At least one of the two images is there.

    Attributes:
        name: unique in the scene, usable as a file stem.
        rgb: the colour image, None for thermal-only views.
        thermal: the thermal image, None for RGB-only views.
    """

    name: str
    rgb: PosedImage | None
    thermal: PosedImage | None

    def __post_init__(self) -> None:
        if self.rgb is None and self.thermal is None:
            raise ValueError(f"view {self.name} has neither an RGB nor a thermal image")

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras of the images that are there: RGB first."""
        return tuple(image.camera for image in (self.rgb, self.thermal) if image is not None)

    @property
    def shares_camera(self) -> bool:
        """Whether both images are there and one camera serves both."""
        return (
            self.rgb is not None
            and self.thermal is not None
            and self.rgb.camera.coincides_with(self.thermal.camera)
        )


def spread(count: int, most: int = 5) -> list[int]:
    """Indices of at most ``most`` of ``count`` views, evenly spread, the first and the last among
    them."""
    return sorted({round(index) for index in np.linspace(0, count - 1, min(count, most))})
