"""The thermal camera against the RGB camera: intrinsics, distortion and rigid offset, without a calibration target."""

from mrgs.prepare.rig.calibrate import calibrate_rig
from mrgs.prepare.rig.contract import RigCalibration, RigOptions, RigPair, RigView

__all__ = ["RigCalibration", "RigOptions", "RigPair", "RigView", "calibrate_rig"]
