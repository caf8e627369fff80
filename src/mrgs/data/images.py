"""Decoding image files. Pillow reads them; only PNG, JPEG and TIFF are let in, and arrays of NumPy,
and none with more pixels than its bytes can hold.

The EXIF orientation is ignored on purpose: structure-from-motion tools work on the pixels as
stored. What the tags of GDAL say of the numbers of a TIFF counts: the value of missing pixels, the
scale, the offset and the unit.
"""

from __future__ import annotations

import io
import math
import os
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Shaped, UInt8
from PIL import Image, UnidentifiedImageError
from PIL.ExifTags import Base
from PIL.JpegImagePlugin import JpegImageFile
from PIL.TiffImagePlugin import TiffImageFile
from torch import Tensor

from mrgs.data.files import MAX_FILE_BYTES
from mrgs.errors import ConfigError, SceneError, scene_error
from mrgs.scene.radiometry import ZERO_CELSIUS_K
from mrgs.system.disk import open_regular
from mrgs.system.wording import quoted

MAX_PIXELS = 80_000_000
"""Larger images are refused unread."""

FREE_PIXELS, PIXELS_PER_BYTE = 25_000_000, 40
"""Images larger than this with more pixels for each byte of their file are refused too: a photo has
ten at most, a mask more, and a small file that unfolds to many pixels would take minutes."""

LIMIT_VARIABLE = "MRGS_MAX_MEGAPIXELS"
"""An environment variable that replaces these limits."""

MOST_SCANS, _START_OF_SCAN = 500, b"\xff\xda\x00"
"""Scans from which on a JPEG is refused, and what begins one. A progressive JPEG has about ten;
each may take ten bytes, and visits all pixels. With the first byte of its length, no signal that
cameras append looks like many."""

DRAFT_SHARES = (8, 4, 2)
"""Reductions that a JPEG decoder offers in each direction, by transforming fewer frequencies."""

DRAFT_MARGIN = 2
"""A photo that is to be made smaller is decoded with at least this multiple of its pixels across:
made smaller from there or from all of its pixels, it differs by less than an 8-bit level (RMS)."""

Kind = Literal["grey", "colour", "float"]
"""One channel of integers, three channels of integers, or one channel of numbers: a TIFF of floats,
or of integers with a scale; an array."""

FORMATS, NPY_SIGNATURE = ("PNG", "JPEG", "TIFF"), b"\x93NUMPY"
_LEAST_SIDE = 8
"""Arrays with fewer rows or columns are no images."""

_GDAL_METADATA, _GDAL_NODATA = 42112, 42113
_GDAL_ITEM = re.compile(r"<Item\b([^<>]*)>([^<]*)<")
_GDAL_ROLE = re.compile(r"""\brole=["'](scale|offset|unittype)["']""")
TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""The transposition to upright by EXIF orientation; 1 is upright."""

_PIXELS_AT_ONCE = 2**16

LUMINANCE = torch.tensor([0.299, 0.587, 0.114])
"""ITU-R BT.601, as in JPEG; they add up to 1, so that a grey image in colour keeps its values."""


@dataclass(frozen=True)
class ImageInfo:
    """Size and kind of an image file, from its header."""

    width: int
    height: int
    kind: Kind


def probe(path: Path) -> ImageInfo:
    """Size and kind of an image, from its header alone. SceneError if it is not an image, too
    large, or has pixels of a type that is not supported."""
    with opened(path) as image:
        return ImageInfo(*stored_size(image), kind_of(image, path))


def upright(image: Image.Image, orientation: int) -> Image.Image:
    """An image with the given EXIF orientation (1 to 8), rotated upright."""
    return image.transpose(_TURNS[orientation]) if orientation in _TURNS else image


def stored_size(image: Image.Image) -> tuple[int, int]:
    """Width and height of an image file that Pillow has just opened, as stored: of a TIFF, Pillow
    gives those of the upright picture."""
    is_lying = getattr(image, "tag_v2", {}).get(Base.Orientation) in range(5, 9)
    return image.size[::-1] if is_lying else image.size


def as_stored(image: Image.Image) -> Image.Image:
    """The pixels of an image file that Pillow has just opened, as stored: while loading a TIFF, and
    no other file, Pillow turns it upright. ValueError for a JPEG of ``MOST_SCANS`` or more."""
    scans = image.fp if isinstance(image, JpegImageFile) else None  # Pillow has read up to them
    if scans and scans.read().count(_START_OF_SCAN) >= MOST_SCANS:
        raise ValueError(f"it has {MOST_SCANS} scans or more")
    orientation = image.getexif().get(Base.Orientation, 1) if image.format == "TIFF" else 1
    return upright(image, {6: 8, 8: 6}.get(orientation, orientation))


def numbers_of(image: Image.Image, in_celsius: bool = True) -> Shaped[np.ndarray, "h w"]:
    """The numbers of an image file of one channel that Pillow has just opened, as stored; with the
    scale and the offset that the tags of GDAL give, and NaN where they say that a pixel is missing.
    Floats are in °C where a tag names K or °F, unless ``in_celsius`` is False. The type is the
    file's, unless a tag needs a float."""
    values = np.array(as_stored(image))
    tags = getattr(image, "tag_v2", {_GDAL_NODATA: image.info.get("nodata")})
    nodata = _number(tags.get(_GDAL_NODATA))
    with np.errstate(over="ignore"):
        missing = values == (np.float32(nodata) if values.dtype == np.float32 else nodata)
    if scaling := scaling_of(image):
        factor, offset = scaling
        with np.errstate(over="ignore", invalid="ignore"):
            values = (values * np.float64(factor) + offset).astype(np.float32)
    if in_celsius and values.dtype == np.float32:
        values = _celsius(values, _gdal_items(image).get("unittype") or image.info.get("unit", ""))
    return np.where(missing, np.float32(np.nan), values) if missing.any() else values


def holds_numbers(image: Image.Image) -> bool:
    """Whether the pixels are numbers rather than shades: floats, or integers with a scale."""
    mode = image.mode
    return mode == "F" or ((mode == "L" or mode.startswith("I")) and scaling_of(image) is not None)


def scaling_of(image: Image.Image) -> tuple[float, float] | None:
    """The factor and the offset that the tags of GDAL give; None if they change nothing."""
    items = _gdal_items(image)
    found = _number(items.get("scale") or 1), _number(items.get("offset") or 0)
    return None if found == (1.0, 0.0) or found[0] == 0 or not np.isfinite(found).all() else found


def _gdal_items(image: Image.Image) -> dict[str, str]:
    """What the tags of GDAL say of the band: its scale, offset and unittype, as far as they do."""
    text = getattr(image, "tag_v2", {}).get(_GDAL_METADATA)
    items = _GDAL_ITEM.findall(text) if isinstance(text, str) else []
    return {found[1]: value for keys, value in items if (found := _GDAL_ROLE.search(keys))}


def _celsius(values: Float32[np.ndarray, "h w"], unit: str) -> Float32[np.ndarray, "h w"]:
    """Temperatures in °C, from those in a unit of GDAL's tags: K, °F, or anything else as it is."""
    name = unit.lower().strip(" °")
    if name in ("k", "kelvin"):
        return (values.astype(np.float64) - ZERO_CELSIUS_K).astype(np.float32)
    if name in ("f", "degf", "deg f", "fahrenheit"):
        return ((values.astype(np.float64) - 32) / 1.8).astype(np.float32)
    return values


def _number(text: object) -> float:
    try:
        return float(str(text).strip("\0 "))
    except ValueError:
        return math.nan


class Decoded(NamedTuple):
    """The pixels of an image file.

    Attributes:
        values: [H, W, C]; integers scaled to [0, 1] by the largest value of their type (8 or 16
            bit), floats as they are; C = 1 for grey and float images, 3 for colour.
        valid: [H, W], False where a pixel is transparent (alpha under one half) or not finite (its
            value is then 0); None if all are usable.
    """

    values: Float32[Tensor, "h w c"]
    valid: Bool[Tensor, "h w"] | None
    kind: Kind


def decode(path: Path, least_width: int | None = None) -> Decoded:
    """The pixels of an image. SceneError if it is damaged, cut off, or refused by ``probe``. A JPEG
    file is decoded at a half, a quarter or an eighth of its size, if that is still ``least_width``
    pixels wide and its size divides: much faster, and each pixel is about the mean of those that it
    stands for. None decodes every pixel."""
    with opened(path) as image:
        kind = kind_of(image, path)
        for share in DRAFT_SHARES if least_width is not None else ():
            width, height = image.width // share, image.height // share
            if (width * share, height * share) == image.size and width >= (least_width or 0):
                image.draft(None, (width, height))
                break
        is_grey = image.mode == "L" and "transparency" not in image.info
        if kind == "float" or image.mode.startswith("I") or is_grey:
            values = numbers_of(image).astype(np.float32)
            finite = np.isfinite(values)
            known = np.where(finite, values, np.float32(0))
            if kind != "float":
                known /= np.float32(255 if is_grey else 65535)
            return Decoded(torch.from_numpy(known[..., None]), _mask(finite), kind)
        mode = "L" if kind == "grey" else "RGB"
        if image.mode.endswith(("A", "a")) or "transparency" in image.info:
            mode += "A"
        pixels = np.asarray(as_stored(image).convert(mode), dtype=np.uint8)
    pixels = pixels.reshape(pixels.shape[0], pixels.shape[1], -1)
    channels = 1 if kind == "grey" else 3
    valid = _mask(pixels[..., channels] >= 128) if pixels.shape[2] > channels else None
    values = pixels[..., :channels].astype(np.float32)
    values /= 255  # in place: a photo of 48 megapixels takes 0.6 GB
    return Decoded(torch.from_numpy(values), valid, kind)


def with_channels(values: Float32[Tensor, "h w c"], channels: int) -> Float32[Tensor, "h w d"]:
    """Intensities with a number of channels: equal ones of a grey image; the luminance of a colour
    image, where one is wanted. ValueError for other numbers of channels."""
    if values.shape[2] == 3 and channels == 1:
        return values @ LUMINANCE[:, None]
    if values.shape[2] not in (1, channels):
        raise ValueError(f"has {values.shape[2]} channels where {channels} are expected")
    return values.expand(-1, -1, channels)


def is_coloured(image: Decoded) -> bool:
    """Whether an image has colours, more than JPEG compression leaves of shades of grey."""
    return float(image.values.std(dim=-1, correction=0).mean()) > _COLOURED


NARROW = 0.1
"""The counts of a camera have a smaller spread, as a share of 16 bits, in all photos."""

_COLOURED = 0.008
"""Standard deviation of the channels, 0 to 1, from which on an image is not grey."""


def eight_bit_levels(values: Float32[Tensor, "*shape"]) -> UInt8[Tensor, "*shape"] | None:
    """The 8-bit levels of which ``decode`` made these values; None if any value is not of these."""
    levels = (values * 255).round_().clamp_(0, 255)
    return levels.to(torch.uint8) if torch.equal(levels / 255, values) else None


def has_eight_bit_levels(values: Float32[Tensor, "h w c"]) -> bool:
    """Whether ``eight_bit_levels`` would find them, a few rows at a time."""
    rows = max(1, _PIXELS_AT_ONCE // max(values.shape[1], 1))
    return all(eight_bit_levels(block) is not None for block in values.split(rows))


def of_eight_bit_levels(levels: UInt8[Tensor, "*shape"]) -> Float32[Tensor, "*shape"]:
    """What ``decode`` makes of 8-bit levels."""
    # On a GPU, torch would multiply by the reciprocal of a Python number, with other bits.
    return levels.to(torch.float32) / torch.full((), 255.0, device=levels.device)


def decode_mask(path: Path) -> Bool[Tensor, "h w"]:
    """A mask image: False where it is black; in a JPEG where it is darker than half, because its
    compression leaves greys on both sides of an edge. Errors as for ``decode``."""
    with opened(path) as image:
        black = 0.5 if image.format == "JPEG" else 0.0
    return (decode(path).values > black).any(dim=-1)


def read_float_tiff(path: Path) -> Float32[np.ndarray, "h w"]:
    """Numbers of a TIFF with one channel of float32, as ``numbers_of``. SceneError if the file is
    damaged, or of another kind."""
    with opened(path, formats=("TIFF",)) as image:
        if image.mode != "F":
            raise scene_error(path, f"is not a TIFF with one float32 channel (mode {image.mode})")
        return numbers_of(image)


def _mask(usable: np.ndarray) -> Bool[Tensor, "h w"] | None:
    return None if usable.all() else torch.from_numpy(usable)


def kind_of(image: Image.Image, path: Path) -> Kind:
    """The kind of an image that Pillow has just opened. SceneError for pixels of a type that is not
    supported; ``path`` is for the message."""
    mode = image.mode
    if holds_numbers(image):
        return "float"
    if mode in {"1", "L", "LA", "La"} or mode.startswith("I;16"):
        return "grey"
    if mode in {"P", "PA", "RGB", "RGBA", "RGBa", "RGBX", "CMYK", "YCbCr", "LAB", "HSV"}:
        return "colour"
    raise scene_error(
        path,
        f"has pixels of type {mode}; save numbers as 32-bit float, shades with 8 or 16 bits",
    )


@contextmanager
def opened(
    path: Path, content: bytes | None = None, formats: tuple[str, ...] = FORMATS
) -> Iterator[Image.Image]:
    """Pillow's image; every failure of opening or decoding it is a SceneError. ``content`` is an
    image found in the file, None for the file; ``formats`` are those let in, by Pillow's names."""
    too_large = ""
    try:
        # Not by its path: Pillow would map a TIFF into memory, and scramble one on its side.
        with open_regular(path) if content is None else io.BytesIO(content) as file:
            size = os.fstat(file.fileno()).st_size if content is None else len(content)
            most_pixels = _most_pixels(size)
            too_large = (
                f"has more than {most_pixels / 1e6:.3g} megapixels, the limit for a file of "
                f"{size / 1e6:.3g} MB; reduce it, or set {LIMIT_VARIABLE}"
            )
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of large images, and of damaged tags
                try:
                    image: Image.Image = Image.open(file, formats=formats)
                    if _is_misread(image):
                        image = _opened_by_gdal(file, path, most_pixels, image.mode == "I")
                except UnidentifiedImageError:
                    file.seek(0)
                    is_array = formats == FORMATS and file.read(6) == NPY_SIGNATURE
                    read = _opened_array if is_array else _opened_by_gdal
                    image = read(file, path, most_pixels)
            with image:
                if image.width * image.height > most_pixels:
                    raise scene_error(path, too_large)
                yield image
    except (ConfigError, SceneError):
        raise
    except Image.DecompressionBombError:
        raise scene_error(path, too_large) from None
    # Damaged files make Pillow's plugins raise almost anything: OSError, SyntaxError, ValueError,
    # struct.error, ...
    except Exception as error:
        reason = "no valid header" if isinstance(error, UnidentifiedImageError) else error
        raise scene_error(
            path, f"cannot be decoded as an image ({reason}); copy or export it again"
        ) from None


def _is_misread(image: Image.Image) -> bool:
    """Whether Pillow swaps the bytes of a TIFF twice: of compressed numbers in big-endian order."""
    if not isinstance(image, TiffImageFile) or image.mode not in ("F", "I"):
        return False
    return image.tag_v2.prefix == b"MM" and image.info.get("compression") != "raw"


def _most_pixels(size: int) -> int:
    """Largest number of pixels of an image in a file of ``size`` bytes. ConfigError if the variable
    is not a number of megapixels."""
    if not (stated := os.environ.get(LIMIT_VARIABLE)):
        return min(MAX_PIXELS, max(FREE_PIXELS, PIXELS_PER_BYTE * size))
    try:
        most = round(1e6 * float(stated))
    except (ValueError, OverflowError):
        most = 0
    if most <= 0:
        raise ConfigError(f"{LIMIT_VARIABLE}={quoted(stated)} is not a number of megapixels")
    Image.MAX_IMAGE_PIXELS = max(most, Image.MAX_IMAGE_PIXELS or 0)  # Pillow refuses twice as many
    return most


def _opened_array(file: BinaryIO, path: Path, most_pixels: int) -> Image.Image:
    """An array: unsigned integers of 8 and 16 bits as they are, others of 32 bits; floats of 32."""
    file.seek(0)
    array = np.load(file)
    if array.size > most_pixels:
        raise Image.DecompressionBombError
    values = array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array
    is_image = values.ndim == 2 and min(values.shape) >= _LEAST_SIDE and values.dtype.kind in "fiub"
    if not is_image:
        what = f"an array {[*array.shape]} of {array.dtype}"
        raise scene_error(path, f"holds {what}; save the numbers of one image, [height, width]")
    if values.dtype.kind == "b":  # a mask
        values = 255 * values.astype(np.uint8)
    kind = np.dtype(np.float32) if values.dtype.kind == "f" else np.dtype(np.int32)
    if values.dtype.kind == "u" and values.dtype.itemsize <= 2:
        kind = values.dtype.newbyteorder("=")
    with np.errstate(over="ignore"):
        image = Image.fromarray(np.ascontiguousarray(values, dtype=kind))
    image.format = "NPY"
    return image


def _opened_by_gdal(
    file: BinaryIO, path: Path, most_pixels: int, has_integers: bool = False
) -> Image.Image:
    """A TIFF of one channel that Pillow does not know, or misreads: integers of 8 and 16 bits
    without a scale as they are, others as 32-bit floats, or as 32-bit integers if it
    ``has_integers``; ``UnidentifiedImageError`` if it is not a TIFF at all."""
    file.seek(0)
    data = file.read(MAX_FILE_BYTES)
    if not data.startswith(TIFF_SIGNATURES):
        raise UnidentifiedImageError
    try:
        import rasterio
    except ImportError:
        remedy = "install mrgs[export], or save it as little-endian 32-bit float without LERC"
        raise scene_error(path, f"is a TIFF that only rasterio reads; {remedy}") from None
    with rasterio.MemoryFile(data) as memory, memory.open(driver="GTiff") as dataset:
        dtype, scaling = dataset.dtypes[0], (dataset.scales[0], dataset.offsets[0])
        if dataset.count > 1 or dtype.startswith("complex"):
            bands = f"{dataset.count} bands of {dtype}"
            raise scene_error(path, f"has {bands}; save the temperatures alone, as one band")
        if dataset.width * dataset.height > most_pixels:
            raise Image.DecompressionBombError
        band, nodata = dataset.read(1, masked=True), str(dataset.nodata)
        unit = dataset.units[0] or ""
    if scaling == (1, 0) and dtype in ("uint8", "uint16"):
        image = Image.fromarray(band.data)
    elif scaling == (1, 0) and has_integers:
        image = Image.fromarray(band.data.astype(np.int32))
    else:
        numbers = (band * scaling[0] + scaling[1]).astype(np.float32)
        image = Image.fromarray(numbers.filled(np.nan))
        image.info["unit"] = unit
    if image.mode != "F":
        image.info["nodata"] = nodata
    image.format = "TIFF"
    return image
