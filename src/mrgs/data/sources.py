"""A scene as a layout's reader describes it: image files with lenses and poses, before splitting,
undistortion and decoding; and from such a file to the pixels of a pinhole camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from numpy.typing import NDArray
from torch import Tensor

from mrgs.data.images import (
    DRAFT_MARGIN,
    DRAFT_SHARES,
    ImageInfo,
    decode,
    decode_mask,
    has_eight_bit_levels,
    probe,
    with_channels,
)
from mrgs.data.undistort import resize
from mrgs.errors import scene_error
from mrgs.scene import RGB, Camera, Modality, Pixels, PointCloud, PosedImage, WorldFrame
from mrgs.scene.lens import Lens, matrix_of, pinhole_of, undistort
from mrgs.scene.point_cloud import GREY
from mrgs.scene.radiometry import PhotoRecord


class ReadingNotes:
    """Decisions and repairs of the reader, one sentence each: ``all`` in order, for
    ``Scene.notes``; and ``repaired``, errors in the files, of which the user is also warned."""

    def __init__(self) -> None:
        self.all: list[str] = []
        self.repaired: list[str] = []

    def decide(self, text: str) -> None:
        """Record a decision."""
        self.all.append(text)

    def repair(self, text: str) -> None:
        """Record a repair."""
        self.all.append(text)
        self.repaired.append(text)


@dataclass(frozen=True, eq=False)
class ImageSource:
    """An image file with its lens and pose.

    Attributes:
        lens: intrinsics and distortion in pixels of the file.
        viewmat: world to camera, OpenCV axes, [4, 4].
        mask: an image of the same size, black where pixels are ignored; None if all count.
        record: what the camera noted beside it; None if the files do not say.
    """

    path: Path
    lens: Lens
    viewmat: Float64[Tensor, "4 4"]
    mask: Path | None = None
    record: PhotoRecord | None = None


@dataclass(frozen=True, eq=False)
class ViewSource:
    """The image files of a view by modality, never empty. The ``key`` is the path of the first
    without extension; name and split follow from it."""

    key: str
    images: Mapping[Modality, ImageSource]


@dataclass(frozen=True)
class FilenameLists:
    """nerfstudio's explicit split: keys of training and evaluation images; None where not given."""

    train: frozenset[str] | None = None
    eval: frozenset[str] | None = None


@dataclass(frozen=True, eq=False)
class SceneSource:
    """The content of a scene folder; nothing is decoded yet.

    Attributes:
        file: the one that names the images, for messages.
        views: in the file's order; never empty.
        points: start points from the files; None if there are none.
        lists: the explicit split, if the files give one.
        world: what the files say about the frame of the poses.
    """

    root: Path
    file: Path
    views: Sequence[ViewSource]
    points: PointCloud | None
    notes: ReadingNotes
    lists: FilenameLists = field(default_factory=FilenameLists)
    world: WorldFrame = field(default=WorldFrame())


def point_cloud(
    positions: NDArray[np.float64],
    colors: NDArray[np.float64] | None,
    notes: ReadingNotes,
    transform: NDArray[np.float64] | None = None,
) -> PointCloud | None:
    """The finite points of a file, moved by ``transform`` ([3, 4]; None leaves them); None if none
    is left. ``colors`` are RGB in [0, 1]; None gives grey. The notes say how many were dropped."""
    with np.errstate(all="ignore"):
        if transform is not None:
            positions = positions @ transform[:, :3].T + transform[:, 3]
        single = positions.astype(np.float32)
        # Squares must be finite too: distances between points are taken in float32.
        usable = np.isfinite(single * single).all(axis=1)
    if dropped := int((~usable).sum()):
        notes.repair(f"{dropped} start points are not finite; left out.")
    if not usable.any():
        return None
    rgb = np.full(single.shape, GREY) if colors is None else colors
    rgb = rgb.astype(np.float32)[usable]
    return PointCloud(torch.from_numpy(single[usable]), torch.from_numpy(rgb))


Decoder = Callable[[Path, int | None], tuple[Float32[Tensor, "h w c"], Bool[Tensor, "h w"] | None]]
"""The values and the mask of usable pixels of a file, which may be decoded at one of
``DRAFT_SHARES`` of its size, at least as many pixels wide as given; whole if None."""

Prober = Callable[[Path], ImageInfo]


def check_files(source: ImageSource, probed: Prober = probe) -> ImageInfo:
    """Compare the headers of the image and its mask with the intrinsics; nothing is decoded.
    SceneError if a file is missing, unreadable, or of another size than the lens says. ``probed``
    is ``probe``, or remembers the files that several images share."""
    info = probed(source.path)
    _check_size((info.width, info.height), source.lens, source.path)
    if source.mask is not None:
        mask = probed(source.mask)
        _check_size((mask.width, mask.height), source.lens, source.mask)
    return info


def posed_image(
    source: ImageSource, decoder: Decoder, resolution: int | None, keeps_levels: bool = False
) -> PosedImage:
    """The undistorted image, at most ``resolution`` pixels wide (None keeps the file's), read when
    ``load`` is called. SceneError if the distortion leaves nothing of it. ``keeps_levels`` keeps an
    image of 8 bits, undistorted or made smaller, to as many levels, which take less memory."""
    try:
        pinhole = pinhole_of(source.lens)
    except ValueError as error:
        raise scene_error(source.path, f"{error}; correct its distortion coefficients") from None
    camera = Camera(matrix_of(pinhole), source.viewmat, pinhole.width, pinhole.height)
    least_width = None
    if resolution is not None and resolution < camera.width:
        camera = camera.with_width(resolution)
        least_width = DRAFT_MARGIN * resolution
    size = camera.width, camera.height
    files = (source.path,) if source.mask is None else (source.path, source.mask)
    return PosedImage(
        camera,
        partial(_load, source, decoder, keeps_levels, size, least_width),
        files,
        source.record,
        partial(_load, source, decoder, keeps_levels, size),
    )


def decode_intensities(
    path: Path, least_width: int | None, channels: int
) -> tuple[Float32[Tensor, "h w {channels}"], Bool[Tensor, "h w"] | None]:
    """Values in [0, 1] and the mask of usable pixels (None if all are). A grey image gets
    ``channels`` equal ones; of a colour image, where one is wanted, the luminance is taken.
    ``least_width`` as for ``decode``. SceneError if the file cannot be decoded, has floats, or
    another number of channels."""
    values, valid, kind = decode(path, least_width)
    if kind == "float":
        raise scene_error(
            path, "holds floats where intensities are expected; save it with 8 or 16 bits"
        )
    try:
        return with_channels(values, channels), valid
    except ValueError as error:
        raise scene_error(path, str(error)) from error


def decode_rgb(
    path: Path, least_width: int | None = None
) -> tuple[Float32[Tensor, "h w 3"], Bool[Tensor, "h w"] | None]:
    """Colours in [0, 1] and the mask of usable pixels; see ``decode_intensities``."""
    return decode_intensities(path, least_width, RGB.channels)


def _load(
    source: ImageSource,
    decoder: Decoder,
    keeps_levels: bool,
    size: tuple[int, int],
    least_width: int | None,
) -> Pixels:
    """The image, decoded at least so wide, and made smaller where that is wider than ``size``."""
    decoded, valid = decoder(source.path, least_width)
    values = decoded
    lens, size_read = source.lens, (values.shape[1], values.shape[0])
    share = 1  # how many pixels of the lens, across, one of the values stands for
    if least_width is not None:
        shares = {(lens.width / each, lens.height / each): each for each in DRAFT_SHARES}
        share = shares.get(size_read, 1)
    lens = lens.resized(lens.width // share, lens.height // share)
    _check_size(size_read, lens, source.path)
    if source.mask is not None:
        mask = decode_mask(source.mask)
        _check_size((mask.shape[1], mask.shape[0]), source.lens, source.mask)
        height, width = lens.height, lens.width  # a pixel counts if all do that it stands for
        mask = mask.reshape(height, share, width, share).all(dim=3).all(dim=1)
        valid = mask if valid is None else valid & mask
    values, valid = undistort(values, valid, lens)
    if values.shape[1] > size[0]:
        values, valid = resize(values, valid, *size)
    if keeps_levels and values is not decoded and has_eight_bit_levels(decoded):
        values = (values * 255).round_() / 255
    return Pixels(values.contiguous(), valid)


def _check_size(size: tuple[int, int], lens: Lens, path: Path) -> None:
    if size != (lens.width, lens.height):
        raise scene_error(
            path,
            f"is {size[0]}×{size[1]} px, but its intrinsics are for {lens.width}×{lens.height} px; "
            "resize the image or correct the intrinsics",
        )
