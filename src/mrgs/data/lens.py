"""Lenses that files describe."""

from __future__ import annotations

from pathlib import Path

from mrgs.data.files import MAX_MAGNITUDE, scene_error
from mrgs.scene.lens import Lens

_MAX_SIDE_PX = 1_000_000
_SHORTEST_PX = 1e-3
"""Shorter focal lengths are damage."""


def checked_lens(lens: Lens, what: str, file: Path) -> Lens:
    """The lens itself, if its numbers can be those of a camera. SceneError for sizes or focal
    lengths that are not positive, and numbers that are not finite or huge."""
    numbers = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.radial, *lens.tangential)
    if not all(abs(number) <= MAX_MAGNITUDE for number in numbers):
        raise scene_error(
            file, f"the intrinsics of {what} hold NaN, infinity or a huge number; correct them"
        )
    if not (1 <= lens.width <= _MAX_SIDE_PX and 1 <= lens.height <= _MAX_SIDE_PX):
        fault = f"the image size of {what}, {lens.width}×{lens.height}, is not possible; correct it"
        raise scene_error(file, fault)
    if not min(lens.fx, lens.fy) >= _SHORTEST_PX:
        raise scene_error(
            file,
            f"the focal length of {what} is {lens.fx:g}, {lens.fy:g} px; it must be positive: "
            f"correct it",
        )
    return lens
