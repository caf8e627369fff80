"""Views as ``convert_photos`` leaves them."""

from __future__ import annotations

from typing import Any

from mrgs.data.radiometric import ExifFacts
from mrgs.prepare.contract import ConvertedImage, ConvertedView
from mrgs.scene import Modality


def converted_view(
    name: str, files: dict[Modality, str], exif: ExifFacts | None = None, **facts: Any
) -> ConvertedView:
    """A view whose images are these files; sizes and digests are not known."""
    images = {modality: ConvertedImage(file) for modality, file in files.items()}
    return ConvertedView(name, images, exif or ExifFacts(), **facts)
