"""Options of ``prepare``: facts about a set of photos."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from mrgs.data.radiometric import Overrides
from mrgs.errors import ConfigError
from mrgs.prepare.georeference import KnownDistance
from mrgs.prepare.rig.contract import ChessboardTarget

PairRule = Literal["auto", "names", "folders", "time", "thermal"]


@dataclass(frozen=True)
class PrepareOptions:
    """Options of ``prepare``; by default everything is determined from the photos. ConfigError for
    an invalid value, or two options that exclude each other.

    Attributes:
        overrides: values that replace those stored in the thermal photos.
        pairs: how RGB and thermal photos are paired; ``thermal`` uses the thermal photos only.
        pair_table: a CSV file with the pairs.
        tolerance_s: maximum time difference within a pair, seconds.
        camera: the thermal camera whose photos are used of several, see ``find_pairs``.
        poses: a folder with a COLMAP model or a ``transforms.json`` of these photos; None for
            structure from motion.
        one_camera: both images of a pair show the same scene, pixel for pixel; there is no thermal
            camera to calibrate.
        thermal_fov_deg: horizontal field of view of the thermal camera, from its data sheet.
        thermal_camera: a file with its lens, its offset, or both (``read_thermal_camera``).
        target: a chessboard that both cameras see.
        known_distance: between two points in a photo.
        control: a table of control points, check points and scale bars (``read_control``).
        eval_every: hold out every Nth view for evaluation; 0 holds out none.
    """

    overrides: Overrides = field(default_factory=Overrides)
    pairs: PairRule = "auto"
    pair_table: Path | None = None
    tolerance_s: float = 2.0
    camera: str | None = None
    poses: Path | None = None
    one_camera: bool = False
    thermal_fov_deg: float | None = None
    thermal_camera: Path | None = None
    target: ChessboardTarget | None = None
    known_distance: KnownDistance | None = None
    control: Path | None = None
    eval_every: int = 8

    def name_of(self, photos: Path) -> str:
        """The name of a folder of photos, and of the camera where one is chosen of several."""
        name, words = photos.resolve().name, re.sub(r"[^\w.]+", "-", self.camera or "")
        camera = words.strip("-")[:60].rstrip("-")
        return f"{name}-{camera}" if camera else name

    def __post_init__(self) -> None:
        if self.thermal_fov_deg is not None and not 1 <= self.thermal_fov_deg <= 150:
            raise ConfigError(
                f"a horizontal field of view of {self.thermal_fov_deg:g}° is not between 1° and "
                f"150°; take it from the thermal camera's data sheet",
                options=("thermal_fov_deg",),
            )
        if self.eval_every != 0 and self.eval_every < 2:
            raise ConfigError(
                f"one in {self.eval_every} views cannot be held out; give 2 or more, or 0 for none",
                options=("eval_every",),
            )
        others = ("thermal_fov_deg", "thermal_camera", "target")
        given = [name for name in others if getattr(self, name) is not None]
        if self.one_camera and given:
            raise ConfigError(
                "one camera for both images cannot be combined with a second camera; give one of "
                "the two options",
                options=("one_camera", given[0]),
            )


def parse_target(corners: str, square_m: float) -> ChessboardTarget:
    """A chessboard from its inner corners, such as ``7x6``, and the side of its squares.
    ConfigError if that is not two numbers, or no chessboard."""
    if not (counts := re.fullmatch(r"(\d{1,3})[x×](\d{1,3})", corners)):
        raise ConfigError(
            f"the target '{corners}': write the inner corners along and across, for instance 7x6",
            options=("target",),
        )
    return ChessboardTarget((int(counts[1]), int(counts[2])), square_m)


def parse_known_distance(first: str, second: str, metres: float) -> KnownDistance:
    """A distance between two pixels of a view, each such as ``IR_0001:120,85.5``. ConfigError if
    there is no view with a pixel, two views, or no distance."""
    (view, a), (other, b) = _view_and_pixel(first), _view_and_pixel(second)
    if view != other:
        raise ConfigError(
            f"the known distance needs two pixels of one view, not of {view} and {other}",
            options=("known_distance",),
        )
    return KnownDistance(view, a, b, metres)


def _view_and_pixel(text: str) -> tuple[str, tuple[float, float]]:
    found = re.fullmatch(r"(.+):(-?\d+(?:\.\d+)?),(-?\d+(?:\.\d+)?)", text)
    if found is None:
        raise ConfigError(
            f"the known distance '{text}': write NAME:X,Y, for instance IR_0001:120,85",
            options=("known_distance",),
        )
    return found[1], (float(found[2]), float(found[3]))
