"""Conversion of photos to the scene's images: RGB as the camera wrote it; float32 °C where the
thermal photo has temperatures."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import math
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, JpegImagePlugin
from PIL.ExifTags import IFD, Base
from PIL.TiffImagePlugin import IFDRational

from mrgs.data.files import read_bytes
from mrgs.data.images import as_stored, kind_of, opened, upright
from mrgs.data.kept import Cache, Digests, Stamp, digest, stamp_of
from mrgs.data.radiometric import (
    ExifFacts,
    Overrides,
    ThermalPhoto,
    VisibleImage,
    read_thermal_photo,
)
from mrgs.data.radiometric.exif import JPEG_SIGNATURE, PNG_SIGNATURE, clean_text
from mrgs.data.transforms import TRANSFORMS
from mrgs.errors import RunError, SceneError, ToolError, scene_error
from mrgs.pictures.settings import SETTINGS
from mrgs.pictures.values import capitalised
from mrgs.prepare.contract import (
    ConvertedImage,
    ConvertedPhotos,
    ConvertedView,
    Pairing,
    PhotoPair,
    Progress,
    Skipped,
)
from mrgs.scene import RGB, THERMAL, Modality
from mrgs.scene.camera import field_of_view, focal_length
from mrgs.system.atomic import remove, replacing

IMAGE_FOLDERS = {RGB: "images", THERMAL: "thermal"}
"""Folders of the images in the scene's folder."""

VIEWS, CONTENTS = "photos", "contents.json"
"""Names in the cache: the folder of the pairs' results, and the file with digests of the photos."""

_VERSION = 11
"""Raise it when the same photos give other images or facts."""

Orientations = Mapping[Modality, int]
"""The EXIF orientation of all photos of a modality."""

_SUFFIXES = {JPEG_SIGNATURE: ".jpg", PNG_SIGNATURE: ".png"}

LYING = 5
"""EXIF orientation from which on rows and columns change places in the upright image."""


@dataclass(frozen=True)
class ImageFile:
    """An image file in memory: its bytes, suffix such as ``.jpg``, and width and height."""

    content: bytes
    suffix: str
    size: tuple[int, int]


class _Settings(NamedTuple):
    """Settings of the conversion of a pair: the scene's folder, the user's overrides, the unit that
    was guessed for numbers in this file format, and the orientations."""

    scene: Path
    overrides: Overrides
    unit: str | None
    orientations: Orientations


@dataclass(frozen=True)
class _CachedPair:
    """The view of a pair; else the reason why it cannot be used."""

    view: ConvertedView | None
    refusal: str = ""


def convert_photos(
    pairing: Pairing,
    scene: Path,
    overrides: Overrides,
    cache: Cache,
    progress: Progress,
    *,
    turn: bool = True,
) -> ConvertedPhotos:
    """Read all photos, and write them into ``images`` and ``thermal`` of the scene's folder.

    Results of an earlier call, refusals included, are kept if the photos and the overrides are the
    same. A pair with a photo that cannot be read is skipped. All photos of a modality share one
    orientation, that of most; all numbers in one file format share one unit.

    Args:
        scene: the scene's folder, made if it is missing. Images with the names of views are
            replaced.
        turn: rotate the images upright by their EXIF orientation; False keeps them as stored,
            which given poses and lenses are for.

    Raises:
        SceneError: no photo can be used, or they are of different cameras.
        RunError: the scene's folder cannot be written (permissions, a full disk); what is there is
            whole, and the next call resumes.
    """
    orientations = _common_orientations(pairing.pairs) if turn else dict.fromkeys(IMAGE_FOLDERS, 1)
    names = {pair.name for pair in pairing.pairs}
    for file in sorted((cache.folder / VIEWS).glob("*.safetensors")):
        if file.stem not in names:  # a view of an earlier call
            _remove_images(scene, file.stem)
            remove(file)
    contents = Digests(cache.folder / CONTENTS)
    units: dict[str, str] = {}  # of numbers, by suffix: guessed for the first photo
    outcomes: dict[str, _CachedPair] = {}
    refused_without: list[tuple[str, PhotoPair]] = []  # a unit of their suffix

    def convert(suffix: str, pair: PhotoPair) -> None:
        settings = _Settings(scene, overrides, units.get(suffix), orientations)
        outcome = outcomes[pair.name] = _cached(pair, settings, cache, contents)
        if outcome.view is None and suffix not in units:
            refused_without.append((suffix, pair))
        elif outcome.view and outcome.view.facts.unit is not None and overrides.bounds_c is None:
            units.setdefault(suffix, outcome.view.facts.unit)

    try:
        for index, pair in enumerate(pairing.pairs):
            progress("reading and writing", index, len(pairing.pairs))
            convert(pair.photos[THERMAL].suffix.lower(), pair)
        progress("reading and writing", len(pairing.pairs), len(pairing.pairs))
        for suffix, pair in refused_without:
            if suffix in units:  # by a later photo
                convert(suffix, pair)
    finally:
        with suppress(RunError):  # a full disk: the next call reads them again
            contents.save(forget_others=len(outcomes) == len(pairing.pairs))
    views = [each.view for each in outcomes.values() if each.view is not None]
    skipped = [Skipped(name, each.refusal) for name, each in outcomes.items() if not each.view]
    if not views:
        first = f"; the first: {skipped[0].reason}" if skipped else "; find pairs first"
        raise SceneError(f"none of the {len(pairing.pairs)} pairs can be used{first}")
    if with_c := [view for view in views if view.range_c is not None]:
        reason = "its thermal photo holds no temperatures, while those of others do"
        skipped += [Skipped(view.name, reason) for view in views if view.range_c is None]
        views = with_c  # the others cannot be compared with these
    for item in skipped:
        _remove_images(scene, item.name)
    _check_sizes(views, pairing)
    return ConvertedPhotos(tuple(views), tuple(skipped), _differing_parameters(views))


def _cached(pair: PhotoPair, settings: _Settings, cache: Cache, contents: Digests) -> _CachedPair:
    """The pair's view or refusal, from the cache if the content of its photos is unchanged, and its
    images are there."""

    def make() -> _CachedPair:
        try:
            return _CachedPair(_convert(pair, stamps, settings))
        except SceneError as error:
            # Permissions, a network drive, another program: the next call may find them in order.
            if isinstance(error, ToolError) or not all(map(digest, pair.photos.values())):
                raise
            return _CachedPair(None, str(error))

    try:
        stamps = _stamps(pair)
        held = [contents.of(path) for path in pair.photos.values()]
        return cache.get(
            f"{VIEWS}/{pair.name}",
            _CachedPair,
            (_VERSION, pair, held, *settings[1:]),
            make,
            lambda found: [
                settings.scene / image.file
                for image in (found.view.images.values() if found.view else ())
            ],
        )
    except SceneError as error:
        return _CachedPair(None, str(error))


def _convert(pair: PhotoPair, stamps: Sequence[Stamp], settings: _Settings) -> ConvertedView:
    """Read a pair, rotate it upright and write it."""
    scene, overrides, unit, orientations = settings
    source, rgb = pair.photos[THERMAL], pair.exif.get(RGB, ExifFacts())
    if unit is not None:
        overrides = dataclasses.replace(overrides, unit=unit)
    thermal = read_thermal_photo(source, overrides)
    files = {RGB: None, THERMAL: _thermal_file(thermal, orientations[THERMAL])}
    if RGB in pair.photos:
        files[RGB] = read_rgb(pair.photos[RGB], orientations[RGB], rgb.orientation)
    elif pair.embedded:
        files[RGB] = read_embedded(thermal.facts.visible, source, orientations[THERMAL])
    if _stamps(pair) != stamps:
        raise scene_error(
            source, "this photo or its RGB photo changed while it was read; wait until it is copied"
        )
    _remove_transforms(scene)
    images = {}
    for modality, file in files.items():
        if file is not None:
            name = f"{IMAGE_FOLDERS[modality]}/{pair.name}{file.suffix}"
            with replacing(scene / name) as temporary:
                temporary.write_bytes(file.content)
            digest_of_file = hashlib.sha256(file.content).hexdigest()
            images[modality] = ConvertedImage(name, file.size, digest_of_file)
    _remove_images(scene, pair.name, keep=[image.file for image in images.values()])
    notes = () if unit is None else (f"The numbers are taken for {unit}.",)
    taken = thermal.facts.taken or rgb.taken
    view_deg = thermal.facts.field_of_view_deg
    if view_deg is not None and orientations[THERMAL] >= LYING:
        height, width = thermal.valid.shape
        focal_px = focal_length(width, math.radians(view_deg))
        view_deg = math.degrees(field_of_view(height, focal_px))
    facts = thermal.facts.adding(notes=notes, visible=None, taken=taken, field_of_view_deg=view_deg)
    own = pair.exif.get(THERMAL, ExifFacts())
    camera = (rgb.make, rgb.model) if rgb.model else (own.make, own.model or facts.camera)
    exif = ExifFacts(*camera, rgb.taken or facts.taken, rgb.gps or facts.gps)
    celsius = thermal.temperature_c
    range_c = None if celsius is None else (float(np.nanmin(celsius)), float(np.nanmax(celsius)))
    return ConvertedView(pair.name, images, exif, facts, range_c)


def _thermal_file(thermal: ThermalPhoto, orientation: int) -> ImageFile:
    """A float TIFF in °C, or a grey PNG without temperatures."""
    if thermal.temperature_c is not None:
        suffix, pixels = ".tiff", np.where(thermal.valid, thermal.temperature_c, np.float32(np.nan))
    else:
        assert thermal.relative is not None
        suffix, pixels = ".png", np.rint(255 * thermal.relative).astype(np.uint8)
    image, file = upright(Image.fromarray(pixels), orientation), io.BytesIO()
    image.save(file, suffix[1:].upper())
    return ImageFile(file.getvalue(), suffix, image.size)


def read_rgb(path: Path, orientation: int, own: int = 1) -> ImageFile:
    """A photo, rotated upright by the given EXIF orientation instead of its ``own``. If no rotation
    is needed, its bytes are kept; else its format and quality, and of its EXIF data the camera, the
    focal length and the time. SceneError for anything but a JPEG, PNG or TIFF image, and if it is
    damaged, cut off or too large."""
    data = read_bytes(path)
    suffix = next((suffix for mark, suffix in _SUFFIXES.items() if data.startswith(mark)), None)
    with opened(path, data) as image:
        kind_of(image, path)
        stored = as_stored(image)
        stored.load()
        if suffix is not None and orientation == own == 1:
            return ImageFile(data, suffix, stored.size)
        return _turned(stored, orientation, suffix or ".png")


def read_embedded(visible: VisibleImage | None, path: Path, orientation: int) -> ImageFile:
    """The RGB photo in a thermal photo's file, with its path. SceneError if missing or damaged."""
    if visible is None:
        raise scene_error(
            path, "holds no visible photo, while others do; leave it out, or add its RGB photo"
        )
    image = Image.fromarray(visible.pixels())
    if orientation == 1 and visible.data.startswith(JPEG_SIGNATURE):
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


def _common_orientations(pairs: Sequence[PhotoPair]) -> Orientations:
    """The most frequent one of each modality; the smallest of equally frequent ones."""
    common = {}
    for modality in IMAGE_FOLDERS:
        counts = Counter(pair.exif[modality].orientation for pair in pairs if modality in pair.exif)
        common[modality] = min(counts, key=lambda each: (-counts[each], each), default=1)
    return common


def _stamps(pair: PhotoPair) -> list[Stamp]:
    """The state of the pair's files; a ``SceneError`` if one is gone."""
    try:
        return [stamp_of(path) for path in pair.photos.values()]
    except OSError as error:
        raise scene_error(
            error.filename, f"cannot be read ({error.strerror}); it was there before, put it back"
        ) from None


def _remove_images(scene: Path, name: str, keep: Iterable[str] = ()) -> None:
    """Remove a view's images, in any format, except those to keep."""
    kept = {scene / path for path in keep}
    for folder in IMAGE_FOLDERS.values():
        for suffix in (".jpg", ".png", ".tiff"):
            path = scene / folder / f"{name}{suffix}"
            if path not in kept and path.is_file():
                _remove_transforms(scene)
                remove(path)


def _remove_transforms(scene: Path) -> None:
    """A scene whose images change is incomplete until it is written again."""
    if (scene / TRANSFORMS).is_file():
        remove(scene / TRANSFORMS)


def _check_sizes(views: Sequence[ConvertedView], pairing: Pairing) -> None:
    """Refuse photos of a modality that have different sizes: one camera must have taken them."""
    photos = {pair.name: pair.photos for pair in pairing.pairs}
    for modality in IMAGE_FOLDERS:
        groups: dict[tuple[int, int] | None, list[Path]] = {}
        for view in views:
            image, files = view.images.get(modality), photos[view.name]
            file = files.get(modality, files[THERMAL])  # an RGB photo may be embedded
            groups.setdefault(None if image is None else image.size, []).append(file)
        if len(groups) > 1:
            (size, most), (other_size, other) = sorted(
                groups.items(), key=lambda group: -len(group[1])
            )[:2]
            counts = [
                "no" if each is None else "{} x {}".format(*each) for each in (other_size, size)
            ]
            raise scene_error(
                other[0],
                f"its {modality.title} image has {counts[0]} pixels, while {len(most)} such as "
                f"{most[0].name} have {counts[1]}; photos of two cameras cannot be one scene, "
                f"remove those of one",
            )


def _differing_parameters(views: Sequence[ConvertedView]) -> tuple[str, ...]:
    """A warning for each parameter of the temperatures that is not the same in all photos."""
    known = [view.facts.parameters for view in views if view.facts.parameters is not None]
    found = []
    for name in SETTINGS:
        values = {
            round(getattr(one, name), 4)
            for one in known
            if name != "window_c" or one.window_transmission != 1  # no effect without a window
        }
        if len(values) > 1:
            label, unit, _ = SETTINGS[name]
            ends = f"{min(values):g} to {max(values):g}{unit}".replace("-", "−")
            found.append(
                f"{capitalised(label)} differs between the photos ({ends}): one surface then has "
                f"several temperatures. Give one value for all."
            )
    return tuple(found)
