"""What a browser may send, checked before anything uses it."""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias

import msgspec
import numpy as np
import torch
from msgspec import UNSET, UnsetType

from mrgs.marks.mark import MarkKind
from mrgs.pictures.palette import PaletteName
from mrgs.scene import Camera
from mrgs.scene.rotations import rigid_transform
from mrgs.viewer.source import Effort

LONGEST_SIDE_PX = 4096
VIDEO_SECONDS = 0.5, 600.0
LARGEST_MESSAGE = 65_536
"""Bytes."""

FARTHEST = 1e9
"""Scene units, also pixels: numbers beyond have no meaning in a picture."""

Number: TypeAlias = Annotated[float, msgspec.Meta(ge=-FARTHEST, le=FARTHEST)]
Positive: TypeAlias = Annotated[float, msgspec.Meta(gt=1e-3, le=FARTHEST)]
Share: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1)]
Side: TypeAlias = Annotated[int, msgspec.Meta(ge=1, le=LONGEST_SIDE_PX)]
Index: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=10**9)]
Seconds: TypeAlias = Annotated[float, msgspec.Meta(ge=VIDEO_SECONDS[0], le=VIDEO_SECONDS[1])]
Limits: TypeAlias = tuple[Number, Number]


class BrowserMessage(msgspec.Struct, forbid_unknown_fields=True):
    """Anything that a browser sends; its class is that of ``type``."""


class Look(BrowserMessage, tag="look"):
    """Draw a picture from a camera whose axes in the world (right, down, forward) are the rows of
    ``rotation``, for a window of the screen's pixels; ``number`` is returned with it."""

    number: Index
    rotation: Annotated[tuple[Number, ...], msgspec.Meta(min_length=9, max_length=9)]
    position: tuple[Number, Number, Number]
    focal: tuple[Positive, Positive]
    centre: tuple[Number, Number]
    width: Side
    height: Side
    effort: Effort

    def camera(self) -> Camera:
        """The camera to draw from; ValueError if the rotation is not one."""
        rotation = np.array(self.rotation).reshape(3, 3)
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
            raise ValueError("the camera's axes must be of unit length and perpendicular")
        (fx, fy), (cx, cy) = self.focal, self.centre
        K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
        viewmat = rigid_transform(rotation, -rotation @ np.array(self.position))
        return Camera(K, viewmat, self.width, self.height)


class Choose(BrowserMessage, tag="choose"):
    """The choices of the panel, see ``Settings``; ``limits`` and ``isotherm`` are those of the
    modality named ``scaled``."""

    mode: Index
    palette: PaletteName
    scaled: str | None
    limits: Limits | None
    isotherm: Limits | None
    share: Share
    marks: bool


class Hover(BrowserMessage, tag="hover"):
    """Report the value under the cursor; x and y from 0 to 1 over the picture."""

    x: Share
    y: Share


class ReadPoint(BrowserMessage, tag="read"):
    """Read the point under a place of the picture; x and y from 0 to 1."""

    x: Share
    y: Share


Corners: TypeAlias = Annotated[
    tuple[tuple[Share, Share], ...], msgspec.Meta(min_length=1, max_length=200)
]
Text: TypeAlias = Annotated[str, msgspec.Meta(max_length=10_000)]
"""Longer than any field of a mark may be: ``Mark`` itself refuses with a sentence."""


class AddMark(BrowserMessage, tag="add_mark"):
    """Add a mark through places of the picture, x and y from 0 to 1; a box has two corners."""

    kind: MarkKind
    points: Corners


class ChangeMark(BrowserMessage, tag="change_mark"):
    """Give the mark of a number (see ``MarkNumbers``) other fields; those left out stay."""

    mark: Index
    name: Text | UnsetType = UNSET
    note: Text | UnsetType = UNSET
    severity: Text | UnsetType = UNSET
    emissivity: Number | UnsetType | None = UNSET
    reflected_c: Number | UnsetType | None = UNSET

    @property
    def fields(self) -> dict[str, Any]:
        """The fields that change, by name."""
        names = [name for name in self.__struct_fields__ if name != "mark"]
        return {name: found for name in names if (found := getattr(self, name)) is not UNSET}


class DeleteMark(BrowserMessage, tag="delete_mark"):
    """Delete the mark of a number."""

    mark: Index


class Judge(BrowserMessage, tag="judge"):
    """Make the report's proposal of a name a mark, or drop it."""

    mark: Text
    accept: bool


class ReferTo(BrowserMessage, tag="refer_to"):
    """Let all differences refer to the mark of a number; None for none."""

    mark: Index | None


class GoToPhoto(BrowserMessage, tag="photo"):
    """Choose a captured view, by its index in the subject's views."""

    index: Index


class FitScales(BrowserMessage, tag="fit"):
    """Lock the scales at the limits of what the picture shows."""


class Undo(BrowserMessage, tag="undo"):
    """Undo the last change of the marks."""


class TakeScreenshot(BrowserMessage, tag="screenshot"):
    """Write the picture into a file."""


class AddKeyframe(BrowserMessage, tag="add_keyframe"):
    """Add the picture's camera to the path."""


class ClearPath(BrowserMessage, tag="clear_path"):
    """Remove all keyframes."""


class SavePath(BrowserMessage, tag="save_path"):
    """Write the keyframes into a file."""

    seconds: Seconds


class RenderVideo(BrowserMessage, tag="video"):
    """Render the path through the keyframes."""

    seconds: Seconds


AnyMessage: TypeAlias = (
    Look | Choose | Hover | ReadPoint | GoToPhoto | FitScales
    | AddMark | ChangeMark | DeleteMark | Judge | ReferTo | Undo
    | TakeScreenshot | AddKeyframe | ClearPath | SavePath | RenderVideo
)  # fmt: skip

_decoder = msgspec.json.Decoder(AnyMessage)


def decode(data: str | bytes) -> AnyMessage:
    """A message from a browser; ValueError if it is not JSON, unknown, or out of its range."""
    try:
        return _decoder.decode(data)
    except ValueError as error:
        raise ValueError(
            f"the viewer does not understand what the page sent: reload the page ({error})"
        ) from error


def encode(value: object) -> str:
    """A message to a browser as JSON; ? stands for what is not UTF-8 in the name of a file."""
    try:
        return msgspec.json.encode(value, enc_hook=_plain_text).decode()
    except UnicodeEncodeError:
        return msgspec.json.encode(_with_valid_texts(value)).decode()


def _with_valid_texts(value: Any) -> Any:
    """Plain values, with ? for what is not UTF-8 in their texts."""
    match value:
        case str():
            return value.encode("utf-8", "replace").decode()
        case list() | tuple():
            return [_with_valid_texts(each) for each in value]
        case dict():
            return {name: _with_valid_texts(each) for name, each in value.items()}
    return value


def _plain_text(value: object) -> str:
    """A Message, or another kind of text, as JSON knows it."""
    if isinstance(value, str):
        return str(value)
    raise TypeError(f"{type(value)} cannot be sent to a browser")
