"""What the user may say about a set of photos."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from mrgs.data.radiometric import Overrides
from mrgs.errors import ConfigError
from mrgs.prepare.georeference import KnownDistance
from mrgs.prepare.rig import ChessboardTarget


@dataclass(frozen=True)
class PrepareOptions:
    """Options of ``prepare``; every default means that it is found from the photos.

    Attributes:
        overrides: what is known better than the thermal photos say.
        pairs: how the photos of one moment are told; ``thermal`` leaves the RGB photos out.
        pair_table: a CSV with the pairs; None for none.
        tolerance_s: photos farther apart in time are no pair, seconds.
        poses: a folder with a COLMAP model or a ``transforms.json`` of these photos; None to find
            their poses.
        one_camera: the two images of a pair show the same pixel for pixel: no thermal camera is
            looked for.
        thermal_fov_deg: horizontal field of view of the thermal camera, from its data sheet.
        thermal_camera: a file with its lens, its offset, or both (``read_thermal_camera``).
        target: a chessboard that both cameras see.
        known_distance: between two things in a photo.
        eval_every: every so manieth view is held out for scoring; 0 holds none out.

    Raises:
        ConfigError: a value that cannot be, or two options that exclude each other.
    """

    overrides: Overrides = field(default_factory=Overrides)
    pairs: Literal["auto", "names", "folders", "time", "thermal"] = "auto"
    pair_table: Path | None = None
    tolerance_s: float = 2.0
    poses: Path | None = None
    one_camera: bool = False
    thermal_fov_deg: float | None = None
    thermal_camera: Path | None = None
    target: ChessboardTarget | None = None
    known_distance: KnownDistance | None = None
    eval_every: int = 8

    def __post_init__(self) -> None:
        if self.thermal_fov_deg is not None and not 1 <= self.thermal_fov_deg <= 150:
            raise ConfigError(
                f"a horizontal field of view of {self.thermal_fov_deg:g}° is not between 1° and "
                f"150°; "
                "take it from the thermal camera's data sheet"
            )
        if self.eval_every != 0 and self.eval_every < 2:
            raise ConfigError(
                f"one in {self.eval_every} views cannot be held out; give 2 or more, or 0 for none"
            )
        others = {
            "--thermal-fov": self.thermal_fov_deg,
            "--thermal-camera": self.thermal_camera,
            "--target": self.target,
        }
        given = [name for name, value in others.items() if value is not None]
        if self.one_camera and given:
            raise ConfigError(
                f"--one-camera and {given[0]} exclude each other; give one of the two"
            )


def parse_target(corners: str, square_m: float) -> ChessboardTarget:
    """A chessboard from its inner corners, such as ``7x6``, and the side of its squares.

    Raises:
        ConfigError: not two numbers, or no chessboard.
    """
    if not (counts := re.fullmatch(r"(\d{1,3})[x×](\d{1,3})", corners)):
        raise ConfigError(
            f"--target {corners}: write the inner corners along and across, for instance 7x6"
        )
    return ChessboardTarget((int(counts[1]), int(counts[2])), square_m)


def parse_known_distance(first: str, second: str, metres: float) -> KnownDistance:
    """A distance between two pixels of a view, each such as ``IR_0001:120,85.5``.

    Raises:
        ConfigError: no view with a pixel, two views, or no distance.
    """
    ends = [
        re.fullmatch(r"(.+):(-?\d+(?:\.\d+)?),(-?\d+(?:\.\d+)?)", text) for text in (first, second)
    ]
    for text, end in zip((first, second), ends, strict=True):
        if end is None:
            raise ConfigError(
                f"--known-distance {text}: write NAME:X,Y, for instance IR_0001:120,85"
            )
    (view, *a), (other, *b) = (end.groups() for end in ends if end is not None)
    if view != other:
        raise ConfigError(
            f"--known-distance: both pixels must be of one view, not of {view} and {other}"
        )
    return KnownDistance(view, (float(a[0]), float(a[1])), (float(b[0]), float(b[1])), metres)
