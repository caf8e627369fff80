"""Results of the stages of ``prepare``: a dataclass for each."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from jaxtyping import Float64, Int64
from torch import Tensor

from mrgs.data.radiometric import ExifFacts, GpsPosition, PhotoFacts
from mrgs.errors import SceneError
from mrgs.scene import RGB, THERMAL, EarthPosition, Modality, PointCloud, WorldFrame
from mrgs.scene.lens import Lens

Progress = Callable[[str, int, int], None]
"""Called with a step's name, how many parts are done, and of all (0 and 0 if not known)."""

CACHE_FOLDER = "prepare"
"""Folder of intermediate results inside the scene's folder."""

MIN_VIEWS = 3
"""Fewest views with a pose in a scene."""


@dataclass(frozen=True)
class PhotoPair:
    """The photos of one moment.

    Attributes:
        name: of the future view; unique, a valid file stem on every system.
        photos: files by modality, RGB first. An RGB photo that is embedded in the thermal photo's
            file, or missing, is not among them.
        embedded: whether the RGB photo embedded in the thermal photo's file is used.
        exif: of each file.
    """

    name: str
    photos: Mapping[Modality, Path]
    embedded: bool = False
    exif: Mapping[Modality, ExifFacts] = field(default_factory=dict)


@dataclass(frozen=True)
class Skipped:
    """A file or a view that is not used, and why: half a sentence."""

    name: str
    reason: str


class SeveralCamerasError(SceneError):
    """Photos are of several thermal cameras, and a scene has one; ``cameras`` are their names."""

    def __init__(self, message: str, cameras: tuple[str, ...]) -> None:
        super().__init__(message, options=("camera",))
        self.cameras = cameras


class TooFewPosesError(SceneError):
    """Structure from motion found too few poses; ``failed`` lists the images without one."""

    def __init__(self, message: str, failed: tuple[Skipped, ...]) -> None:
        super().__init__(message)
        self.failed = failed


@dataclass(frozen=True)
class Pairing:
    """The pairs of a folder of photos, in natural order of their names; files without a partner,
    and files that are not photos; how the pairs were found, one sentence; and warnings."""

    pairs: tuple[PhotoPair, ...]
    skipped: tuple[Skipped, ...]
    rule: str
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class ConvertedImage:
    """An image file, relative to the scene; its width and height in pixels; SHA-256."""

    file: str
    size: tuple[int, int]
    sha256: str = ""


@dataclass(frozen=True)
class ConvertedView:
    """A pair whose images are in the scene's folder.

    Attributes:
        images: by modality. ``images/NAME.*`` is the RGB image, missing in a thermal-only set.
            ``thermal/NAME.*`` is a float32 TIFF in °C, NaN where there is no temperature; an 8-bit
            grey PNG if the photos hold no temperatures.
        exif: of the RGB photo, completed from the thermal photo.
        facts: what the thermal camera recorded in its file: emissivity, reflected temperature,
            serial number, time and so on; without the embedded photo.
        range_c: lowest and highest temperature, °C; None without temperatures.
    """

    name: str
    images: Mapping[Modality, ConvertedImage]
    exif: ExifFacts
    facts: PhotoFacts = field(default_factory=lambda: PhotoFacts("image"))
    range_c: tuple[float, float] | None = None


@dataclass(frozen=True)
class ConvertedPhotos:
    """All photos that could be read, written into the scene's folder; pairs that are skipped, with
    the reader's message; and warnings about the whole set."""

    views: tuple[ConvertedView, ...]
    skipped: tuple[Skipped, ...]
    warnings: tuple[str, ...] = ()

    def to_pose(self) -> tuple[Modality, dict[str, ConvertedImage]]:
        """The images that get poses, by view, and their modality: RGB, if there are any."""
        modality = RGB if any(RGB in view.images for view in self.views) else THERMAL
        return modality, {
            view.name: view.images[modality] for view in self.views if modality in view.images
        }


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Poses of the images, from structure from motion or given by the user.

    Attributes:
        viewmats: world to camera, OpenCV axes, [4, 4], by the view's name; registered views only.
        lenses: of each registered view, for its image at full size; views of one camera share
            theirs.
        visible: for each registered view, the indices of the points that it observes; None if not
            known.
        failed: views without a pose, and why.
        reprojection_px: mean reprojection error of the points; None if not known.
        source: origin of the poses, one sentence.
        images: modality of the images with these poses.
        warnings: sentences that the user should read.
        world: what is known of the frame of given poses.
    """

    viewmats: Mapping[str, Float64[Tensor, "4 4"]]
    lenses: Mapping[str, Lens]
    points: PointCloud
    visible: Mapping[str, Int64[Tensor, " k"]] | None
    failed: tuple[Skipped, ...]
    reprojection_px: float | None
    source: str
    images: Modality = RGB
    warnings: tuple[str, ...] = ()
    world: WorldFrame = field(default=WorldFrame())


@dataclass(frozen=True)
class ControlResidual:
    """Found minus stated, metres, of a ``control`` or ``check`` point or of a ``length``; distance
    of its marks, px (RMS); in how many photos these are; and what a point is off along the axes."""

    name: str
    role: str
    off_m: float
    error_px: float
    photos: int
    shift_m: tuple[float, float, float] | None = None


def rms_m(residuals: Sequence[ControlResidual], role: str) -> float | None:
    """Root mean square of those with a role, metres; None if there are none."""
    squares = [each.off_m**2 for each in residuals if each.role == role]
    return math.sqrt(sum(squares) / len(squares)) if squares else None


@dataclass(frozen=True, eq=False)
class Georeference:
    """A similarity from the world of the poses to the scene's world: x' = scale · rotation x +
    translation.

    Attributes:
        scale: new lengths over old ones.
        metric: whether the new lengths are metres.
        north: whether the new axes are east, north, up.
        origin: position of the new origin on Earth; None if not known.
        residual_m: median distance of the cameras from their GPS positions; None without GPS.
        scale_error: standard uncertainty of the scale, as a share; None where neither GPS nor
            control points give it.
        text: one or two sentences for the user.
        offset: of the new origin in the control points' local frame, metres; None if they agree.
        control: what control points, check points and stated lengths are off.
        control_m: the same of given poses, see ``WorldFrame``.
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
    scale_error: float | None = None
    offset: tuple[float, float, float] | None = None
    control: tuple[ControlResidual, ...] = ()
    control_m: float | None = None

    @property
    def world(self) -> WorldFrame:
        """The frame of the scene's world."""
        place, origin = self.origin, None
        if place is not None:
            origin = EarthPosition(place.latitude_deg, place.longitude_deg, place.altitude_m)
        roles = ("check", "control", "length")
        off_m = next(filter(None, (rms_m(self.control, role) for role in roles)), self.control_m)
        known = self.residual_m, self.scale_error, self.offset, off_m
        return WorldFrame(self.metric, self.north, origin, *known)


@dataclass(frozen=True)
class StageSummary:
    """The result of a stage, for the user: a sentence a line, the most important first."""

    lines: tuple[str, ...]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class StageReport:
    """A finished stage, for the terminal and for the page.

    Attributes:
        title: such as "poses".
        lines: its results, one sentence each.
        seconds: how long it took; 0 if its result was reused.
        reused: whether the result of an earlier call was reused.
    """

    title: str
    lines: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0
    reused: bool = False


@dataclass(frozen=True)
class Preparation:
    """Result of ``prepare``: the scene's folder, the HTML page that shows it, the stages' reports,
    and files and views that are not in the scene."""

    scene: Path
    page: Path
    stages: tuple[StageReport, ...]
    skipped: tuple[Skipped, ...] = ()
