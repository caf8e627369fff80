"""Where on the picture each part stands, and through which cameras it looks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch

from mrgs.scene import RGB, THERMAL, Camera, Modality, PosedImage, View
from mrgs.viewer.settings import Mode

Content = Literal[
    "rgb", "temperature", "depth", "blend", "split", "rgb_photo", "thermal_photo", "difference"
]

_GAP_PX = 4


@dataclass(frozen=True, eq=False)
class Pane:
    """One part of the picture.

    Attributes:
        content: what it shows.
        camera: what it looks through; width and height are those of the pane in the picture.
        left: of its upper left corner, pixels of the picture.
        top: the same.
        title: drawn into its corner; may be empty.
        photo: the photo that it shows or compares with, if any.
    """

    content: Content
    camera: Camera
    left: int = 0
    top: int = 0
    title: str = ""
    photo: PosedImage | None = None

    @property
    def shows_temperature(self) -> bool:
        """Whether its pixels have the colours of the temperature scale."""
        return self.content in ("temperature", "blend", "split", "thermal_photo")


class Place(NamedTuple):
    """A point of a pane: u to the right and v down, 0 to 1 over the pane."""

    pane: Pane
    u: float
    v: float


def panes_of(mode: Mode, camera: Camera, view: View | None) -> tuple[Pane, ...]:
    """The panes of a mode.

    Args:
        mode: what to show.
        camera: the browser's, as large as the picture.
        view: the captured view that the modes with photos show; must be there for them.
    """
    if mode == "side_by_side":
        half = _cropped(camera, camera.width // 2)
        right = camera.width - half.width
        return Pane("rgb", half, title="Colour"), Pane(
            "temperature", half, left=right, title="Temperature"
        )
    if mode == "photos":
        assert view is not None
        return _photo_panes(view, camera.width, camera.height)
    if mode == "difference":
        assert view is not None
        photo = view.images.get(THERMAL)
        if photo is None:
            return ()
        box = (0, 0, camera.width, camera.height)
        title = f"model - thermal photo {view.name}"
        return (_fitted("difference", photo.camera, box, title, photo),)
    return (Pane(mode, camera),)


def place_at(panes: Sequence[Pane], x: float, y: float) -> Place | None:
    """The place under a pixel of the picture; None between the panes."""
    for pane in panes:
        u, v = (x - pane.left) / pane.camera.width, (y - pane.top) / pane.camera.height
        if 0 <= u < 1 and 0 <= v < 1:
            return Place(pane, u, v)
    return None


def _photo_panes(view: View, width: int, height: int) -> tuple[Pane, ...]:
    """A row for each modality of the view: the photo, and the model from the same camera."""
    shown_as: dict[Modality, tuple[Content, Content, str]] = {
        RGB: ("rgb_photo", "rgb", "colour"),
        THERMAL: ("thermal_photo", "temperature", "thermal"),
    }
    rows = [(view.images[each], *how) for each, how in shown_as.items() if each in view.images]
    panes = []
    row_height = (height - _GAP_PX * (len(rows) - 1)) // len(rows)
    half = (width - _GAP_PX) // 2
    for number, (photo, shown, rendered, name) in enumerate(rows):
        top = number * (row_height + _GAP_PX)
        left_box, right_box = (0, top, half, row_height), (half + _GAP_PX, top, half, row_height)
        panes.append(_fitted(shown, photo.camera, left_box, f"{name} photo {view.name}", photo))
        panes.append(_fitted(rendered, photo.camera, right_box, f"{name}, the model", photo))
    return tuple(panes)


def _fitted(
    content: Content, camera: Camera, box: tuple[int, int, int, int], title: str, photo: PosedImage
) -> Pane:
    """The whole of a captured image, as large as the box (left, top, width, height) allows, in its
    middle."""
    left, top, width, height = box
    scale = min(width / camera.width, height / camera.height)
    size = max(1, int(camera.width * scale)), max(1, int(camera.height * scale))
    left, top = left + (width - size[0]) // 2, top + (height - size[1]) // 2
    return Pane(content, camera.resized(*size), left, top, title, photo)


def _cropped(camera: Camera, width: int) -> Camera:
    """The middle columns of an image."""
    K = camera.K.clone()
    K[0, 2] -= 0.5 * (camera.width - width)
    return Camera(torch.as_tensor(K), camera.viewmat, width, camera.height)
