"""An RGB photo as a scene's file: the camera's bytes if possible, else rotated or converted."""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, JpegImagePlugin
from PIL.ExifTags import IFD, Base
from PIL.TiffImagePlugin import IFDRational

from mrgs.data.files import read_bytes, scene_error
from mrgs.data.images import as_stored, opened, probe, upright
from mrgs.data.radiometric import VisibleImage, read_exif
from mrgs.data.radiometric.exif import clean_text

_SUFFIXES = {b"\xff\xd8\xff": ".jpg", b"\x89PNG": ".png"}


@dataclass(frozen=True)
class ImageFile:
    """An image file in memory: its bytes, suffix such as ``.jpg``, and width and height."""

    content: bytes
    suffix: str
    size: tuple[int, int]


def read_rgb(path: Path, orientation: int) -> ImageFile:
    """A photo, rotated upright by the given EXIF orientation, not its own. If no rotation is
    needed, its bytes are kept; else its format and quality, and of its EXIF data the camera, the
    focal length and the time. SceneError for anything but a JPEG, PNG or TIFF image, and if it is
    damaged, cut off or too large."""
    probe(path)
    data = read_bytes(path)
    suffix = next((suffix for mark, suffix in _SUFFIXES.items() if data.startswith(mark)), None)
    with opened(path, data) as image:
        stored = as_stored(image)
        stored.load()
        if suffix is not None and orientation == read_exif(data).orientation == 1:
            return ImageFile(data, suffix, stored.size)
        return _turned(stored, orientation, suffix or ".png")


def read_embedded(visible: VisibleImage | None, path: Path, orientation: int) -> ImageFile:
    """The RGB photo embedded in a thermal photo's file, with its path. SceneError if there is none,
    or it is damaged."""
    if visible is None:
        raise scene_error(
            path, "holds no visible photo, while others do; leave it out, or add its RGB photo"
        )
    image = Image.fromarray(visible.pixels())
    if orientation == 1 and visible.data.startswith(b"\xff\xd8\xff"):
        return ImageFile(visible.data, ".jpg", image.size)
    return _turned(image, orientation, ".png")


def _turned(original: Image.Image, orientation: int, suffix: str) -> ImageFile:
    """The image rotated upright; a JPEG keeps the quality of the original, and some of its EXIF."""
    image, file = upright(original, orientation), io.BytesIO()
    if suffix == ".jpg" and isinstance(original, JpegImagePlugin.JpegImageFile):
        sampling = JpegImagePlugin.get_sampling(original)
        image.save(
            file,
            "JPEG",
            qtables=original.quantization,
            subsampling=sampling if sampling in (0, 1, 2) else 0,
            exif=_kept_exif(original),
        )
    else:
        mode = image.mode if image.mode in ("L", "RGB", "RGBA", "LA") else "RGB"
        image.convert(mode).save(file, "PNG")
    return ImageFile(file.getvalue(), suffix, image.size)


def _kept_exif(original: Image.Image) -> bytes:
    """The camera, focal length and time as new EXIF, as Pillow cannot write all that it reads;
    empty if the original's is too damaged."""
    kept = Image.Exif()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            main = original.getexif()
            photo = main.get_ifd(IFD.Exif)
            texts = {tag: clean_text(main.get(tag)) for tag in (Base.Make, Base.Model)}
            kept.update({tag: text for tag, text in texts.items() if text is not None})
            details = kept.get_ifd(IFD.Exif)
            if taken := clean_text(photo.get(Base.DateTimeOriginal)):
                details[Base.DateTimeOriginal] = taken
            focal_mm, film_mm = photo.get(Base.FocalLength), photo.get(Base.FocalLengthIn35mmFilm)
            if isinstance(focal_mm, (int, float, IFDRational)) and 0 < float(focal_mm) < 1e5:
                details[Base.FocalLength] = IFDRational(float(focal_mm))
            if isinstance(film_mm, int) and 0 < film_mm < 2**16:
                details[Base.FocalLengthIn35mmFilm] = film_mm
            return kept.tobytes()
    except Exception:  # Pillow raises almost anything where tags are damaged; the pixels are fine
        return b""
