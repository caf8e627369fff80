"""A scene as a layout's reader describes it: image files with lenses and poses, before splitting,
undistortion and decoding."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from numpy.typing import NDArray
from torch import Tensor

from mrgs.data.lens import Lens
from mrgs.scene import Modality, PointCloud, WorldFrame
from mrgs.scene.point_cloud import GREY
from mrgs.scene.radiometry import PhotoRecord


class ReadingNotes:
    """Decisions and repairs of the reader, one sentence each.

    Attributes:
        all: every sentence in order, for ``Scene.notes``.
        repaired: errors in the files, of which the user is also warned.
    """

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
        path: the image.
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
    """The image files of a view.

    Attributes:
        key: path of its first image without extension; name and split follow from it.
        images: by modality; never empty.
    """

    key: str
    images: Mapping[Modality, ImageSource]


@dataclass(frozen=True)
class FilenameLists:
    """nerfstudio's explicit split: keys of the training and of the evaluation images; None where
    not given."""

    train: frozenset[str] | None = None
    eval: frozenset[str] | None = None


@dataclass(frozen=True, eq=False)
class SceneSource:
    """The content of a scene folder; nothing is decoded yet.

    Attributes:
        root: the folder, resolved.
        file: the one that names the images, for messages.
        views: in the file's order; never empty.
        points: start points from the files; None if there are none.
        lists: the explicit split, if the files give one.
        notes: decisions and repairs.
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
    """Points of a file, moved by ``transform`` ([3, 4]; None leaves them), without those that are
    not finite.

    Args:
        positions: [N, 3].
        colors: RGB in [0, 1], [N, 3]; None gives middle grey.
        notes: receives how many points were dropped.
        transform: an affine map to world coordinates.

    Returns:
        The points, None if none is left.
    """
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
    rgb = (
        np.full(single.shape, GREY, dtype=np.float32)
        if colors is None
        else colors.astype(np.float32)
    )
    return PointCloud(torch.from_numpy(single[usable]), torch.from_numpy(rgb[usable]))
