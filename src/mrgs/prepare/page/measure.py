"""The section in which two clicks on a photo and a length give the scene its scale."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

import torch
from PIL import Image

from mrgs.data.posed import decode_rgb
from mrgs.data.undistort import resize
from mrgs.pictures.files import to_rgb8
from mrgs.prepare.contract import DevelopedView, Georeference
from mrgs.prepare.page.markup import paragraph, picture, section
from mrgs.scene.view import spread

MOST_PHOTOS = 6
WIDTH_PX = 760


def measure_section(
    scene: Path, views: Sequence[DevelopedView], georeference: Georeference | None
) -> str:
    """The section; nothing where no photo has a pose.

    The photos are shown as they lie in the scene, not undistorted: the option takes their pixels.

    Args:
        scene: its folder.
        views: those with a pose and an RGB image.
        georeference: what is known of the scale.

    Raises:
        SceneError: a photo cannot be read.
    """
    if not views:
        return ""
    chosen = [views[index] for index in spread(len(views), MOST_PHOTOS)]
    options = "".join(f"<option>{escape(view.name)}</option>" for view in chosen)
    photos = "".join(_photo(scene, view) for view in chosen)
    content = (
        paragraph(_why(georeference))
        + f'<div class="controls"><label>Photo <select id="measure-view">{options}</select></label>'
        + '<label>Distance <input id="measure-length" type="number" min="0" step="any" value="1"> '
        "m</label>"
        + '<button id="measure-clear">Clear</button></div>'
        + f'<div id="measure-photos">{photos}</div>'
        + '<p id="measure-option" role="status">Click the two points in the photo.</p>'
    )
    return section("measure", "Set the scale by a known distance", content)


def _why(georeference: Georeference | None) -> str:
    how = (
        "Click two points whose distance you know and type the distance; then run mrgs prepare "
        "again with the option "
        "that appears below. Choose points on clear marks of one firm surface, as far apart as "
        "the photo shows."
    )
    if georeference is not None and georeference.metric:
        return (
            f"The scene is in metres already. Should lengths come out wrong: "
            f"{how[0].lower()}{how[1:]}"
        )
    return f"The scale of the scene is not known. {how}"


def _photo(scene: Path, view: DevelopedView) -> str:
    """A photo to click on; it says how large its file is."""
    assert view.rgb is not None
    values, _ = decode_rgb(scene / view.rgb)
    height, width = values.shape[:2]
    if width > WIDTH_PX:
        values, _ = resize(
            values.contiguous(), None, WIDTH_PX, max(1, round(height * WIDTH_PX / width))
        )
    image = picture(
        Image.fromarray(to_rgb8(values.to(torch.float32))), f"photo {view.name}", quality=75
    )
    name = escape(view.name)
    return (
        f'<div class="clickable" data-view="{name}" data-width="{width}" '
        f'data-height="{height}" hidden>{image}</div>'
    )
