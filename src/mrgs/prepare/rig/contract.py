"""What the calibration of a thermal camera against an RGB camera takes and gives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float64, Int64
from torch import Tensor

from mrgs.data.lens import Lens
from mrgs.scene import Pixels, PosedImage


@dataclass(frozen=True, eq=False)
class RigPair:
    """An RGB photo and the thermal photo of the same moment.

    Attributes:
        name: for messages.
        rgb: the photo, undistorted, with its pose.
        load_thermal: reads the thermal photo as the camera took it (distorted); one channel in any unit.
        visible: indices of the points that this photo was seen to see (the tracks of structure from motion); None if
            that is not known: then hidden points are told by their depth.
    """

    name: str
    rgb: PosedImage
    load_thermal: Callable[[], Pixels]
    visible: Int64[Tensor, " k"] | None = None


@dataclass(frozen=True, eq=False)
class RigOptions:
    """What is known beforehand, and what is accepted.

    Attributes:
        thermal_lens: intrinsics and distortion of the thermal camera, taken as they are; None to find them.
        thermal_from_rgb: rigid motion from the RGB camera to the thermal camera [4, 4] in scene units, taken as it is;
            None to find it.
        field_of_view_deg: horizontal, of the thermal camera, from its data sheet; narrows the search to ±10 %.
        max_uncertainty_px: a result less certain than this (one standard deviation) is refused, in thermal pixels.
    """

    thermal_lens: Lens | None = None
    thermal_from_rgb: Float64[Tensor, "4 4"] | None = None
    field_of_view_deg: float | None = None
    max_uncertainty_px: float = 4.0


@dataclass(frozen=True, eq=False)
class RigView:
    """The thermal camera of one pair.

    Attributes:
        name: the pair's.
        correction: what the rig's motion is followed by in this pair [4, 4], in the thermal camera's axes and scene
            units: two shutters rarely fire together.
        matches: number of patches that were found in both images and agree with the result.
        residual_px: median distance of these patches from where the result puts them, in thermal pixels.
        uncertainty_px: one standard deviation of the position of what the RGB camera sees, median over its points.
    """

    name: str
    correction: Float64[Tensor, "4 4"]
    matches: int
    residual_px: float
    uncertainty_px: float


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """The thermal camera of a rig.

    Attributes:
        lens: the thermal camera's intrinsics and distortion, for its photos as they are.
        thermal_from_rgb: the rig's rigid motion from RGB camera to thermal camera axes [4, 4], in scene units.
        views: one for each pair, in their order.
        residual_px: median and 90 % quantile of the matched patches' distances, in thermal pixels.
        uncertainty_px: median over the views.
        motion_px: median over the views of how far the correction moves the image, in thermal pixels.
        warnings: sentences that the user should read.
    """

    lens: Lens
    thermal_from_rgb: Float64[Tensor, "4 4"]
    views: tuple[RigView, ...]
    residual_px: tuple[float, float]
    uncertainty_px: float
    motion_px: float
    warnings: tuple[str, ...]

    def viewmat(self, index: int, rgb_viewmat: Float64[Tensor, "4 4"]) -> Float64[Tensor, "4 4"]:
        """World to the thermal camera of a pair, from world to its RGB camera."""
        return self.views[index].correction @ self.thermal_from_rgb @ rgb_viewmat
