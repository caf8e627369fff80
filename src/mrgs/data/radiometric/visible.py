"""The photo in visible light that many thermal cameras store beside the thermal one, and where it
lies on it."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from mrgs.data.files import scene_error
from mrgs.errors import SceneError

MAX_PIXELS = 20_000_000
"""Larger images are refused before they are decoded; thermal cameras have up to 3 megapixels, times
4 if enhanced."""


@contextmanager
def opened(
    data: io.BytesIO, path: Path, formats: tuple[str, ...], what: str = "it"
) -> Iterator[Image.Image]:
    """Pillow's image, decoded.

    Args:
        formats: Pillow's names of the formats that are let in.

    Raises:
        SceneError: not an image of these formats, damaged, cut off or too large.
    """
    too_large = f"{what} has more than {MAX_PIXELS // 10**6} megapixels; reduce it before use"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # of damaged tags, and of large images: the limit here is lower
            image = Image.open(data, formats=formats)
            if image.width * image.height > MAX_PIXELS:
                raise scene_error(path, too_large)
            image.load()
        with image:
            yield image
    except SceneError:
        raise
    except Image.DecompressionBombError:
        raise scene_error(path, too_large) from None
    except UnidentifiedImageError:  # its text names no file, but an address in memory
        raise scene_error(
            path, f"{what} cannot be decoded as an image (no valid header); export it again"
        ) from None
    except Exception as error:  # Pillow's plugins raise almost anything where files are damaged
        raise scene_error(
            path, f"{what} cannot be decoded as an image ({error}); copy or export it again"
        ) from None


@dataclass(frozen=True)
class Alignment:
    """Alignment of the visible photo with the thermal one, at the distance that the camera was
    focused on.

    Attributes:
        real_to_ir: width of the visible photo over the width of the part of it that the thermal
            photo shows.
        offset_x_px: from the visible photo's centre to that of the thermal photo in it, its pixels,
            to the right.
        offset_y_px: the same, downwards.
        picture_in_picture_px: the thermal inset in the displayed picture: left, right, top, bottom.
    """

    real_to_ir: float
    offset_x_px: int
    offset_y_px: int
    picture_in_picture_px: tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class VisibleImage:
    """A visible photo inside a thermal one.

    Attributes:
        data: the image file, JPEG or PNG, as the camera wrote it.
        source: the file that it was found in, for messages.
        alignment: None if the camera does not say.
    """

    data: bytes
    source: Path
    alignment: Alignment | None

    def pixels(self) -> UInt8[np.ndarray, "h w 3"]:
        """The photo in RGB.

        Cameras that store it as PNG put luma and chroma (JPEG's YCbCr) into the channels for red,
        green and blue.

        Raises:
            SceneError: the photo is damaged.
        """
        with opened(io.BytesIO(self.data), self.source, ("JPEG", "PNG")) as image:
            if image.format == "PNG" and image.mode == "RGB":
                image = Image.merge("YCbCr", image.split())
            return np.array(image.convert("RGB"), dtype=np.uint8)
