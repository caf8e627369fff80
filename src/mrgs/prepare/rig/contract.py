"""Inputs and results of the calibration of a thermal camera relative to an RGB camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float64, Int64
from torch import Tensor

from mrgs.errors import ConfigError, SceneError
from mrgs.scene import Pixels, PosedImage
from mrgs.scene.lens import Lens

FEWEST_CORNERS = 3
_MOST_CORNERS = 50


@dataclass(frozen=True, eq=False)
class RigPair:
    """An RGB photo and the thermal photo of the same moment.

    Attributes:
        photo: undistorted, with its pose.
        load_thermal: reads the thermal photo with its lens distortion; one channel in any unit.
        visible: indices of the points that this photo observes (tracks of structure from motion);
            None if not known: hidden points are then found by their depth.
    """

    name: str
    photo: PosedImage
    load_thermal: Callable[[], Pixels]
    visible: Int64[Tensor, " k"] | None = None


@dataclass(frozen=True)
class ChessboardTarget:
    """A chessboard that both cameras see in some pairs, stationary or moved from pair to pair.
    ConfigError for fewer than 3 or more than 50 corners, or a width that is not positive.

    Attributes:
        inner: number of inner corners, where four squares meet, in a row and in a column; a board
            of 7×6 squares has 6×5.
        square_m: width of a square in metres; None if not known. With it, a stationary
            target gives the scale of the scene.
    """

    inner: tuple[int, int]
    square_m: float | None = None

    def __post_init__(self) -> None:
        if not all(FEWEST_CORNERS <= count <= _MOST_CORNERS for count in self.inner):
            raise ConfigError(
                f"a chessboard of {self.inner[0]}×{self.inner[1]} inner corners cannot be used as "
                f"a target: give how many corners, where four squares meet, are in a row and in a "
                f"column, {FEWEST_CORNERS} to {_MOST_CORNERS} each; a board of 7×6 squares has 6×5",
                options=("target",),
            )
        if self.square_m is not None and not 0 < self.square_m < math.inf:
            raise ConfigError(
                f"the target's squares cannot be {self.square_m:g} m wide: give their width in "
                f"metres",
                options=("target",),
            )


@dataclass(frozen=True, eq=False)
class RigOptions:
    """Known quantities of the rig, and the largest uncertainty that is accepted.

    Attributes:
        thermal_lens: used unchanged; None to calibrate it.
        extrinsics: rigid motion from the RGB camera to the thermal camera [4, 4] in scene
            units, used unchanged; None to find it.
        field_of_view_deg: horizontal, of the thermal camera, from its data sheet; narrows the
            search to ±10 %.
        stated_field_of_view_deg: the same as the photos' files state it; searched first.
        target: a chessboard that is in some of the pairs.
        metres_per_unit: of the scene, if known; only needed for a target that is moved.
        max_uncertainty_px: a result with a larger standard deviation is refused, in thermal
            pixels.
    """

    thermal_lens: Lens | None = None
    extrinsics: Float64[Tensor, "4 4"] | None = None
    field_of_view_deg: float | None = None
    stated_field_of_view_deg: float | None = None
    target: ChessboardTarget | None = None
    metres_per_unit: float | None = None
    max_uncertainty_px: float = 4.0


FEWEST_MATCHES = 12
"""A pair with fewer is placed by the rig, and by what the pairs' motions have in common."""


@dataclass(frozen=True, eq=False)
class RigView:
    """The thermal camera of one pair.

    Attributes:
        correction: the pair's own rigid motion after the rig's [4, 4], in the thermal camera's axes
            and scene units, because two shutters rarely fire together.
        matches: number of patches and target corners that were found in both images and are
            inliers of the result.
        residual_px: their median reprojection error, in thermal pixels.
        uncertainty_px: one standard deviation of the position of what the RGB camera sees, median
            over its points (with few of them, over those of all pairs), in thermal pixels.
    """

    name: str
    correction: Float64[Tensor, "4 4"]
    matches: int
    residual_px: float
    uncertainty_px: float


@dataclass(frozen=True)
class TargetFit:
    """Fit of the calibration to the target.

    Attributes:
        pairs: number of pairs that show it in both images.
        residual_px: median and 90 % quantile for its corners, in thermal pixels.
        metres_per_unit: of the scene; None unless the target is stationary and the width of its
            squares is known.
    """

    pairs: int
    residual_px: tuple[float, float]
    metres_per_unit: float | None


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """A calibrated rig: the thermal camera relative to the photos' camera.

    Attributes:
        lens: the thermal camera's intrinsics and distortion, for its photos as they are.
        extrinsics: the rig's rigid motion from RGB camera to thermal camera axes [4, 4], in
            scene units.
        views: one for each pair, in their order.
        residual_px: median and 90 % quantile of the reprojection errors of all inliers, in thermal
            pixels.
        uncertainty_px: median over the views, in thermal pixels.
        motion_px: displacement of the image by the correction, median over the views, in thermal
            pixels.
        warnings: sentences that the user should read.
    """

    lens: Lens
    extrinsics: Float64[Tensor, "4 4"]
    views: tuple[RigView, ...]
    residual_px: tuple[float, float]
    uncertainty_px: float
    motion_px: float
    warnings: tuple[str, ...]
    target: TargetFit | None = None

    def viewmat(self, name: str, photo_viewmat: Float64[Tensor, "4 4"]) -> Float64[Tensor, "4 4"]:
        """World to the thermal camera of a pair [4, 4], from world to its photo's camera [4, 4].
        SceneError if the pair was not calibrated."""
        for view in self.views:
            if view.name == name:
                return view.correction @ self.extrinsics @ photo_viewmat
        raise SceneError(
            f"the view {name} has a pose but is not in the thermal camera's calibration; calibrate "
            f"it too"
        )
