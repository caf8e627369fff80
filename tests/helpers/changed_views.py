"""Views with other images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from mrgs.scene import Camera, Modality, Pixels, PosedImage, View


def with_image(view: View, modality: Modality, change: Callable[[PosedImage], PosedImage]) -> View:
    """The view with a changed image of a modality."""
    return replace(view, images={**view.images, modality: change(view.images[modality])})


def without(view: View, modality: Modality) -> View:
    """The view without the image of a modality."""
    others = {other: image for other, image in view.images.items() if other != modality}
    return replace(view, images=others)


def with_cameras(view: View, change: Callable[[Camera], Camera]) -> View:
    """The view with all its cameras changed alike."""
    images = {
        modality: replace(image, camera=change(image.camera))
        for modality, image in view.images.items()
    }
    return replace(view, images=images)


def repainted(image: PosedImage, change: Callable[[Pixels], Pixels]) -> PosedImage:
    """The image with other pixels."""
    return replace(image, load=lambda: change(image.load()), load_at_least=None)
