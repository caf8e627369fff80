"""The thermal camera against the RGB camera: intrinsics, distortion and rigid offset, with or
without a target."""

from mrgs.prepare.rig.calibrate import calibrate_rig
from mrgs.prepare.rig.contract import (
    ChessboardTarget,
    RigCalibration,
    RigOptions,
    RigPair,
    RigView,
    TargetFit,
)

__all__ = [
    "ChessboardTarget",
    "RigCalibration",
    "RigOptions",
    "RigPair",
    "RigView",
    "TargetFit",
    "calibrate_rig",
]
