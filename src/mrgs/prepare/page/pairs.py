"""The section that shows each view: photo, thermal image, and one laid over the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from jaxtyping import Float32
from PIL import Image

from mrgs.pictures.drawing import Scale, scale_bar
from mrgs.pictures.palette import colorize, display_range
from mrgs.prepare.page.markup import picture, section
from mrgs.prepare.page.overlay import edge_layer
from mrgs.prepare.page.shots import Shot

THUMBNAIL_PX, SMALL_THUMBNAIL_PX = 320, 240
LARGE_UP_TO = 60
"""With more pairs than this the thumbnails are small, and of more than ``MOST_SHOWN`` some are
shown."""

MOST_SHOWN = 120
_BAR_PX = 420
_HOW = (
    "Are they of the same moment, and does one lie on the other? The picture at the right is the "
    "photo with the "
    "thermal image carried onto it by the cameras' poses and the distance of what they see. "
    "Outlines that miss "
    "everywhere in one direction mean that the thermal camera is misplaced; small shifts at the "
    "borders of near "
    "things do not."
)


def thumbnail_width(count: int) -> int:
    """How wide the images of so many pairs are shown, in pixels."""
    return THUMBNAIL_PX if count <= LARGE_UP_TO else SMALL_THUMBNAIL_PX


def common_range(shots: Sequence[Shot]) -> tuple[float, float]:
    """Limits of the colours of all thermal images."""
    images = [shot.thermal.ravel()[::7] for shot in shots if shot.thermal is not None]
    return display_range(np.concatenate(images)) if images else (0.0, 1.0)


def pairs_section(
    shots: Sequence[Shot], overlays: Mapping[str, Float32[np.ndarray, "h w"]], unit: str, total: int
) -> str:
    """The section.

    Args:
        shots: those that are shown.
        overlays: by the view's name, the thermal image as its photo's camera would have taken it.
        unit: of the thermal values; empty where they are relative.
        total: how many views there are.
    """
    low, high = common_range(shots)
    scale = Scale("inferno", low, high, unit)
    some = (
        f"<p>{len(shots)} of {total} views are shown, evenly spread.</p>"
        if len(shots) < total
        else ""
    )
    cards = "".join(_card(shot, overlays.get(shot.name), scale) for shot in shots)
    bar = picture(
        scale_bar(scale, _BAR_PX, "horizontal"), "scale of the thermal images", kind="bar", png=True
    )
    what = "Temperatures" if unit else "Relative thermal values"
    legend = (
        f'<div class="legend"><span>{what}</span>{bar}</div>'
        if any(s.thermal is not None for s in shots)
        else ""
    )
    controls = _CONTROLS if overlays else ""
    how = f'<p class="note">{escape(_HOW)}</p>' if overlays else ""
    return section(
        "pairs", "Photos", f'{how}{some}{legend}{controls}<div class="cards">{cards}</div>'
    )


_CONTROLS = (
    '<div class="controls" role="group" aria-label="how the images are laid over each other">'
    '<button data-mode="edges" aria-pressed="true">Thermal outlines</button>'
    '<button data-mode="checker" aria-pressed="false">Checkerboard</button>'
    '<button data-mode="blend" aria-pressed="false">Blend</button>'
    '<label>Share of the thermal image <input id="blend" type="range" min="0" max="100" '
    'value="50"></label></div>'
)


def _card(shot: Shot, overlay: Float32[np.ndarray, "h w"] | None, scale: Scale) -> str:
    """One view: its images side by side, its name and its part in the scene."""
    kind = "card" if shot.registered else "card failed"
    pictures = ""
    if shot.rgb is not None:
        pictures += picture(
            Image.fromarray(shot.rgb), f"photo {shot.name}", kind="photo", quality=78
        )
    if shot.thermal is not None:
        pictures += picture(_colored(shot.thermal, scale), f"thermal image {shot.name}", quality=78)
    if overlay is not None:
        pictures += (
            '<div class="stack" role="img" aria-label="thermal image over the photo"><img '
            'class="base" alt="">'
            + picture(_colored(overlay, scale), "", kind="warped", quality=72)
            + picture(edge_layer(overlay), "", kind="edges", png=True)
            + "</div>"
        )
    caption = f"<strong>{escape(shot.name)}</strong> <span>{escape(shot.status)}</span>"
    return (
        f'<figure class="{kind}" data-view="{escape(shot.name)}"><figcaption>{caption}</figcaption>'
        + (f'<div class="images">{pictures}</div></figure>' if pictures else "</figure>")
    )


def _colored(values: Float32[np.ndarray, "h w"], scale: Scale) -> Image.Image:
    return Image.fromarray(colorize(values, scale.low, scale.high, scale.palette))
