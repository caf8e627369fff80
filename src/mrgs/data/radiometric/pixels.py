"""Decoding untrusted images with Pillow: bounded in size; every failure is a SceneError."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
        data: the image file's content.
        path: the file, for messages.
        formats: Pillow's names of the formats that are let in.
        what: the image's name in messages.

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
