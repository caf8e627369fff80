"""A chessboard that both cameras see: found in the images, placed in space, and what it tells of
the thermal camera."""

from mrgs.prepare.rig.target.detect import Corners, detect_chessboard
from mrgs.prepare.rig.target.seen import SeenTarget, see_target

__all__ = ["Corners", "SeenTarget", "detect_chessboard", "see_target"]
