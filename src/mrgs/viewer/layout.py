"""The parts of a picture: their places and their cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch

from mrgs.scene import Camera, Modality, PosedImage, View
from mrgs.viewer.settings import Mode

PaneKind = Literal["image", "depth", "blend", "split", "photo", "difference", "uncertainty"]

_GAP_PX = 4


@dataclass(frozen=True, eq=False)
class Pane:
    """One part of the picture.

    Attributes:
        kind: what it shows: an image of the model, its depth or uncertainty, two images through a
            slider, a photo, or the model minus the photo.
        modalities: of the images that it shows; of two, the left or lower one first.
        camera: what it looks through; width and height are those of the pane in the picture.
        left: column of its upper left corner, pixels of the picture.
        top: row of its upper left corner, pixels of the picture.
        title: drawn into its corner; may be empty.
        photo: the photo that it shows or compares with, if any.
    """

    kind: PaneKind
    modalities: tuple[Modality, ...]
    camera: Camera
    left: int = 0
    top: int = 0
    title: str = ""
    photo: PosedImage | None = None

    @property
    def scaled(self) -> Modality | None:
        """The one-channel modality whose values its colours stand for; None for colours and
        depth."""
        return next((each for each in reversed(self.modalities) if each.channels == 1), None)


class Place(NamedTuple):
    """A point of a pane.

    Attributes:
        pane: that contains it.
        u: to the right, 0 to 1 over the pane.
        v: down, 0 to 1 over the pane.
    """

    pane: Pane
    u: float
    v: float


def panes_of(mode: Mode, camera: Camera, view: View | None) -> tuple[Pane, ...]:
    """The panes of a mode.

    Args:
        mode: what to show.
        camera: the browser's, as large as the picture.
        view: the captured view that the modes with photos show; they need one.
    """
    match mode.kind:
        case "side_by_side":
            return _halves(mode, camera)
        case "photos":
            assert view is not None
            return _photo_panes(mode, view, camera.width, camera.height)
        case "difference":
            assert view is not None
            return _difference_panes(mode, view, camera)
    return (Pane(mode.kind, mode.modalities, camera),)


def place_at(panes: Sequence[Pane], x: float, y: float) -> Place | None:
    """The pane and the place in it at pixel (x, y) of the picture; None between the panes."""
    for pane in panes:
        u, v = (x - pane.left) / pane.camera.width, (y - pane.top) / pane.camera.height
        if 0 <= u < 1 and 0 <= v < 1:
            return Place(pane, u, v)
    return None


def _halves(mode: Mode, camera: Camera) -> tuple[Pane, ...]:
    """Two images of the picture's middle columns, side by side."""
    half = _cropped(camera, camera.width // 2)
    lefts = (0, camera.width - half.width)
    return tuple(
        Pane("image", (modality,), half, left, title=Mode("image", (modality,)).label)
        for modality, left in zip(mode.modalities, lefts, strict=True)
    )


def _photo_panes(mode: Mode, view: View, width: int, height: int) -> tuple[Pane, ...]:
    """A row for each modality of the view: the photo, and the model from the same camera."""
    rows = [modality for modality in mode.modalities if modality in view.images]
    panes = []
    row_height = (height - _GAP_PX * (len(rows) - 1)) // max(len(rows), 1)
    half = (width - _GAP_PX) // 2
    for number, modality in enumerate(rows):
        photo, title = view.images[modality], modality.title
        top = number * (row_height + _GAP_PX)
        left_box, right_box = (0, top, half, row_height), (half + _GAP_PX, top, half, row_height)
        panes.append(_fitted("photo", modality, left_box, f"{title} photo {view.name}", photo))
        panes.append(_fitted("image", modality, right_box, f"{title}, the model", photo))
    return tuple(panes)


def _difference_panes(mode: Mode, view: View, camera: Camera) -> tuple[Pane, ...]:
    """The model minus the view's photo; nothing for a view without one."""
    (modality,) = mode.modalities
    photo = view.images.get(modality)
    if photo is None:
        return ()
    box = (0, 0, camera.width, camera.height)
    title = f"model - {modality.title} photo {view.name}"
    return (_fitted("difference", modality, box, title, photo),)


def _fitted(
    kind: PaneKind,
    modality: Modality,
    box: tuple[int, int, int, int],
    title: str,
    photo: PosedImage,
) -> Pane:
    """The whole of a captured image, as large as the box (left, top, width, height) allows, in its
    middle."""
    left, top, width, height = box
    camera = photo.camera
    scale = min(width / camera.width, height / camera.height)
    size = max(1, int(camera.width * scale)), max(1, int(camera.height * scale))
    left, top = left + (width - size[0]) // 2, top + (height - size[1]) // 2
    return Pane(kind, (modality,), camera.resized(*size), left, top, title, photo)


def _cropped(camera: Camera, width: int) -> Camera:
    """The middle columns of an image."""
    K = camera.K.clone()
    K[0, 2] -= 0.5 * (camera.width - width)
    return Camera(torch.as_tensor(K), camera.viewmat, width, camera.height)
