"""A chessboard that both cameras see: detected, located in space, and used in the calibration."""

from mrgs.prepare.rig.target.detect import Corners, detect_chessboard
from mrgs.prepare.rig.target.observed import ObservedTarget, observe_target

__all__ = ["Corners", "ObservedTarget", "detect_chessboard", "observe_target"]
