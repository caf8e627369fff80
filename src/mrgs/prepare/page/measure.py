"""Photos for measuring: two clicks and a length give the scene its scale."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from PIL import Image

from mrgs.data.images import DRAFT_MARGIN, probe
from mrgs.data.posed import decode_rgb
from mrgs.data.undistort import reduced
from mrgs.pictures.files import to_rgb8
from mrgs.pictures.html import InlineImage, inline_image
from mrgs.prepare.contract import ConvertedView
from mrgs.scene import RGB
from mrgs.scene.view import evenly_spaced

MOST_PHOTOS = 6
WIDTH_PX = 760


class MeasuredPhoto(NamedTuple):
    """A photo to measure in.

    Attributes:
        view: name of its view.
        width: of the file, in pixels.
        height: of the file, in pixels.
        picture: the photo as shown on the page.
    """

    view: str
    width: int
    height: int
    picture: InlineImage


def measured_photos(scene: Path, views: Sequence[ConvertedView]) -> list[MeasuredPhoto]:
    """Some of the photos, evenly distributed, with the lens distortion of the file.

    Args:
        scene: its folder.
        views: those with a pose and an RGB image.

    Raises:
        SceneError: a photo cannot be read.
    """
    return [_photo(scene, views[index]) for index in evenly_spaced(len(views), MOST_PHOTOS)]


def _photo(scene: Path, view: ConvertedView) -> MeasuredPhoto:
    file = scene / view.images[RGB].file
    values, _ = decode_rgb(file, DRAFT_MARGIN * WIDTH_PX)
    info = probe(file)
    image = Image.fromarray(to_rgb8(reduced(values, None, WIDTH_PX)[0]))
    return MeasuredPhoto(
        view.name, info.width, info.height, inline_image(image, f"photo {view.name}", quality=75)
    )
