"""Views as ``convert_photos`` leaves them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mrgs.data.images import probe
from mrgs.data.radiometric import ExifFacts
from mrgs.prepare.contract import ConvertedImage, ConvertedView
from mrgs.scene import Modality


def converted_view(
    name: str,
    files: dict[Modality, str],
    exif: ExifFacts | None = None,
    sizes: dict[Modality, tuple[int, int]] | None = None,
    **facts: Any,
) -> ConvertedView:
    """A view whose images are these files, of these sizes, else 32 x 24; digests are not known."""
    images = {
        modality: ConvertedImage(file, (sizes or {}).get(modality, (32, 24)))
        for modality, file in files.items()
    }
    return ConvertedView(name, images, exif or ExifFacts(), **facts)


def sizes_of(images: Mapping[str, Path]) -> dict[str, tuple[int, int]]:
    """Width and height of image files, by the views' names."""
    found = {name: probe(path) for name, path in images.items()}
    return {name: (info.width, info.height) for name, info in found.items()}
