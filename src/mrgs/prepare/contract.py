"""What the stages of preparing a scene hand to each other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from jaxtyping import Float64, Int64
from torch import Tensor

from mrgs.data.lens import Lens
from mrgs.data.radiometric import ExifFacts, GpsPosition
from mrgs.errors import SceneError
from mrgs.scene import PointCloud

Progress = Callable[[str, int, int], None]
"""Called with a step's name, and how many of its parts are done and there are (0 of 0 where that is
not known)."""

MIN_VIEWS = 3
"""A scene needs poses of so many views."""


@dataclass(frozen=True)
class PhotoPair:
    """The photos of one moment.

    Attributes:
        name: of the view to be; unique, a valid file stem on every system.
        rgb: the photo in visible light; None if it lies in the thermal photo's file, or if there is
            none.
        thermal: the thermal photo.
        embedded: whether the visible photo inside the thermal photo's file is used.
    """

    name: str
    rgb: Path | None
    thermal: Path
    embedded: bool = False


@dataclass(frozen=True)
class LeftOut:
    """A file or a view that is not used, and why (half a sentence)."""

    name: str
    reason: str


class TooFewPosesError(SceneError):
    """Structure from motion placed fewer images than a scene needs.

    Attributes:
        failed: the images without a pose, and why.
    """

    def __init__(self, message: str, failed: tuple[LeftOut, ...]) -> None:
        super().__init__(message)
        self.failed = failed


@dataclass(frozen=True)
class Pairing:
    """Which photos belong together.

    Attributes:
        pairs: in natural order of their names.
        left_out: files without a partner, or that are no photos.
        rule: how the pairs were found, one sentence.
        warnings: sentences that the user should read.
    """

    pairs: tuple[PhotoPair, ...]
    left_out: tuple[LeftOut, ...]
    rule: str
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class DevelopedView:
    """A pair whose images lie in the scene's folder.

    Attributes:
        name: of the pair.
        rgb: the RGB image, ``images/NAME.*`` in the scene's folder, relative to it; None in a
            thermal-only set.
        thermal: the thermal image, ``thermal/NAME.*``: float32 TIFF in °C, NaN where there is no
            temperature; or a grey 8-bit PNG where the photos hold no temperatures.
        exif: of the RGB photo, completed by that of the thermal photo.
        camera: of the thermal photo; None if the file does not say.
        range_c: the coldest and the hottest temperature, °C; None where the photo holds none.
        notes: how the thermal file was understood.
        warnings: what the user should know before trusting its numbers.
    """

    name: str
    rgb: str | None
    thermal: str
    exif: ExifFacts
    camera: str | None = None
    range_c: tuple[float, float] | None = None
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Development:
    """All photos, read and written into the scene's folder.

    Attributes:
        views: those that could be read.
        left_out: pairs with a photo that could not be read, with the reader's message.
        warnings: sentences about the whole set.
    """

    views: tuple[DevelopedView, ...]
    left_out: tuple[LeftOut, ...]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Poses of the images, from structure from motion or from files that the user has.

    Attributes:
        viewmats: world to camera, OpenCV axes, [4, 4], by the view's name; registered views only.
        lenses: the lens of each registered view, for its image as it is; views of one camera share
            theirs.
        points: what was triangulated.
        visible: for each registered view, the indices of the points that it saw; None if that is
            not known.
        failed: views without a pose, and why.
        reprojection_px: mean distance of the points from where they were seen; None if that is not
            known.
        source: how the poses were found, one sentence.
        images: which images the poses belong to.
        warnings: sentences that the user should read.
    """

    viewmats: Mapping[str, Float64[Tensor, "4 4"]]
    lenses: Mapping[str, Lens]
    points: PointCloud
    visible: Mapping[str, Int64[Tensor, " k"]] | None
    failed: tuple[LeftOut, ...]
    reprojection_px: float | None
    source: str
    images: Literal["rgb", "thermal"] = "rgb"
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Georeference:
    """A similarity from the world of the poses to the scene's world: x' = scale · rotation x +
    translation.

    Attributes:
        scale: new lengths over old ones.
        rotation: [3, 3].
        translation: [3].
        metric: whether the new lengths are metres.
        north: whether the new axes are east, north, up.
        origin: the place of the new origin on Earth; None if not known.
        residual_m: median distance of the cameras from their GPS positions; None without GPS.
        text: what was done, one or two sentences, for the user.
        warnings: sentences that the user should read.
    """

    scale: float
    rotation: Float64[Tensor, "3 3"]
    translation: Float64[Tensor, "3"]
    metric: bool
    north: bool
    origin: GpsPosition | None
    residual_m: float | None
    text: str
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class StageReport:
    """What a stage did, for the terminal and for the page.

    Attributes:
        title: of the stage, such as "poses".
        lines: what it did and found, one sentence each.
        warnings: sentences that the user should read.
        seconds: how long it took; 0 if an earlier call did it.
        reused: whether an earlier call did it.
    """

    title: str
    lines: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0
    reused: bool = False


@dataclass(frozen=True)
class Preparation:
    """What ``prepare`` returns: the scene, and what was understood on the way.

    Attributes:
        scene: the scene's folder.
        page: the page that shows it all.
        stages: in order.
        left_out: files and views that are not in the scene.
    """

    scene: Path
    page: Path
    stages: tuple[StageReport, ...]
    left_out: tuple[LeftOut, ...] = field(default=())
