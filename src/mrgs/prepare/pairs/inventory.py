"""The files of a folder of photos: possible photos, and why the others are skipped."""

from __future__ import annotations

import filecmp
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from functools import lru_cache
from pathlib import Path, PurePosixPath

from mrgs.data.files import (
    IMAGE_SUFFIXES,
    composed,
    decoded_text,
    read_bytes,
    visible_files,
    without_image_suffix,
)
from mrgs.data.images import holds_numbers, opened, stored_size
from mrgs.data.kept import Stamp, stamp_of
from mrgs.data.radiometric import ExifFacts, dji, flir, read_exif
from mrgs.data.radiometric.exif import JPEG_SIGNATURE, PNG_SIGNATURE, RECORD_MARKS, flir_record
from mrgs.data.radiometric.read import MAX_BYTES, Kind, reader_of
from mrgs.data.radiometric.table import columns_of, numbers_in
from mrgs.errors import SceneError, printable, scene_error
from mrgs.prepare.contract import Progress, Skipped
from mrgs.prepare.pairs.photo import (
    REFERENCE,
    Photo,
    folder_modality,
    natural,
    read_stem,
    told_apart,
)
from mrgs.scene import THERMAL, Modality
from mrgs.system.disk import open_regular

_HEAD_BYTES = 2**20
"""The header of a JPEG without a thermal record rarely takes more."""

_TABLE_COLUMNS = 8
"""Least number of cells in the longest line of a table of temperatures."""

_COPY = re.compile(r"[ _-]*(?:\(\d+\)|copy(?: ?\d+)?|kopie|copie)$")
"""What file managers append to the names of copies."""

_LOG = re.compile(r"(?i)^\D*\blat(?:itude)?\b\D*\b(?:lon|lng|long|longitude)\b\D*$")
"""The headings of a flight log or of geotags."""

_EPOCH = re.compile(r"(?:.*\D)?(1[3-9]\d{8})(?:\D?(\d{3}|\d{6}|\d{9}))?")
"""Seconds since 1970 at the end of a name, from 2011 on, as recordings of robots write them."""

_NO_PHOTOS = {"depth", "depths", "disp", "disparity", "label", "labels", "mask", "masks", "normals"}
"""Folders with these names, and files that end with them, hold something else than photos."""

_UNSUPPORTED = {
    ".heic", ".heif", ".avif", ".webp", ".bmp", ".gif", ".dng", ".gpr", ".cr2", ".cr3", ".nef",
    ".nrw", ".arw", ".raf", ".orf", ".rw2", ".rwl", ".pef", ".srw", ".sr2", ".3fr", ".iiq", ".erf",
    ".kdc", ".dcr", ".mos",
}  # fmt: skip


_HEIC = {b"ftyp" + brand for brand in (b"heic", b"heix", b"mif1", b"msf1", b"avif", b"crx ")}

NOT_READ = "which is not read; save it as JPEG or PNG"


def inspect(path: Path, relative: PurePosixPath) -> Photo | str:
    """The photo in a file, or half a sentence with the reason why it is not one; ``relative`` is
    its path below the folder of photos. ``1_T.JPG.tiff`` was converted from ``1_T.JPG``."""
    suffix = path.suffix.lower()
    origin = PurePosixPath(without_image_suffix(relative.with_suffix("").as_posix()))
    named = {*map(str.lower, relative.parts[-2:-1]), origin.name.lower().rpartition("_")[2]}
    if said := named & _NO_PHOTOS:
        return f"is not a photo, but {min(said)} by its name"
    told = folder_modality(origin.parts[:-1])[0], read_stem(origin.name).modality
    if suffix == ".npy" and THERMAL not in told:
        return "is an array, and not thermal by its name or folder"
    try:
        data = _head(path)
        if not data:
            return "is empty; copy it again"
        reader = reader_of(data, path)
        is_plain = data.startswith((JPEG_SIGNATURE, PNG_SIGNATURE))
        if suffix in _UNSUPPORTED and not is_plain:  # a raw photo is a TIFF with a preview
            return f"is a {suffix[1:].upper()} file, {NOT_READ}"
        if data[4:12] in _HEIC or data[8:12] == b"WEBP":  # whatever its name says
            return f"is a HEIC, AVIF or WebP file by its content, {NOT_READ}"
        if reader is None:
            return "is not a photo"
        photo = _PHOTOS[reader.kind](path, origin, data)
        if isinstance(photo, str):
            return photo
        if photo.exif.taken is None and (stamp := _EPOCH.fullmatch(origin.name)):
            moment = float(stamp[1]) + float(f"0.{stamp[2] or 0}")
            taken = datetime.fromtimestamp(moment, timezone.utc).replace(tzinfo=None)
            photo = replace(photo, exif=replace(photo.exif, taken=taken, zone_s=0.0))
        name = printable(relative.as_posix())
        return replace(photo, needs_tool=reader.needs_tool, name=name)
    except SceneError as error:
        return str(error).removeprefix(f"{path}: ")


def _head(path: Path) -> bytes:
    """The beginning of a file, from which its kind is recognised; the whole file for a JPEG with
    FLIR's record, which may be longer."""
    try:
        with open_regular(path) as file:
            start = file.read(_HEAD_BYTES)
    except OSError as error:
        raise SceneError(
            f"cannot be read ({error.strerror}); check that it is there and readable"
        ) from None
    has_record = start.startswith(JPEG_SIGNATURE) and any(mark in start for mark in RECORD_MARKS)
    return read_bytes(path, MAX_BYTES) if has_record else start


def _signal(path: Path, origin: PurePosixPath, data: bytes) -> Photo:
    """A camera's signal; FLIR's record, in a JPEG or in a file of its own, is parsed."""
    is_jpeg = data.startswith(JPEG_SIGNATURE)
    record = flir_record(data, path) if is_jpeg else None
    if data.startswith(flir.FFF_SIGNATURES):
        record = read_bytes(path, MAX_BYTES)
    exif = read_exif(data) if is_jpeg else ExifFacts()
    if record is None:  # another maker's
        photo = _image(path, origin, data) if is_jpeg else Photo(path, origin, "signal")
        return replace(photo, kind="signal")
    records = flir.Records(record, path)
    if is_jpeg and records.get(flir.RAW_DATA) is None:  # a photo in visible light
        return _image(path, origin, data)
    camera = flir.camera_facts(records)
    return Photo(
        path,
        origin,
        "signal",
        embedded=records.get(flir.EMBEDDED_IMAGE) is not None,
        exif=replace(exif, model=exif.model or camera.model, taken=exif.taken or camera.taken),
        field_of_view_deg=camera.field_of_view_deg or exif.field_of_view_deg,
        serial=camera.serial,
    )


def _image(path: Path, origin: PurePosixPath, data: bytes, is_whole: bool = False) -> Photo:
    """An image file. Only an unusually long header makes a JPEG worth reading to its end."""
    if not (is_whole or data.startswith(JPEG_SIGNATURE)):
        data, is_whole = read_bytes(path, MAX_BYTES), True
    try:
        with opened(path, data) as image:
            size, has_numbers = stored_size(image), holds_numbers(image)
            kind: Kind = "numbers" if has_numbers or image.mode.startswith("I") else "image"
    except SceneError:
        if is_whole:
            raise
        return _image(path, origin, read_bytes(path, MAX_BYTES), is_whole=True)
    exif = read_exif(data)
    return Photo(
        path,
        origin,
        kind,
        size,
        exif=exif,
        focal_mm=exif.focal_mm,
        field_of_view_deg=exif.field_of_view_deg if kind == "numbers" else None,
        serial=exif.serial,
    )


def _table(path: Path, origin: PurePosixPath, data: bytes) -> Photo | str:
    lines = decoded_text(data).splitlines()[:1000]
    if any(map(_LOG.search, lines)):
        return "is a list of positions"
    is_wide = any(
        numbers_in(line.split()) >= _TABLE_COLUMNS
        or any(line.count(sign) >= _TABLE_COLUMNS - 1 for sign in ";\t,")
        or (len(re.split(r"[;,\t]", line)) == 3 and columns_of(line, 3))
        for line in lines
    )
    return Photo(path, origin, "table") if is_wide else "is not a photo"


def _bare_numbers(path: Path, origin: PurePosixPath, data: bytes) -> Photo | str:
    sizes = {width * height * n for width, height in dji.SIZES for n in (2, 4)}
    is_whole = path.suffix.lower() != ".raw" or path.stat().st_size in sizes
    return Photo(path, origin, "numbers") if is_whole else "is not a photo"


_PHOTOS: dict[Kind, Callable[[Path, PurePosixPath, bytes], Photo | str]] = {
    "signal": _signal,
    "numbers": _bare_numbers,
    "table": _table,
    "image": _image,
}
"""The function that inspects a file of each kind."""


@dataclass(frozen=True)
class Inventory:
    """The photos of a folder, one file for each moment and camera, in natural order of their paths;
    and all other files, but for hidden ones. ``listings`` are those of ``on_disk``."""

    root: Path
    photos: tuple[Photo, ...]
    skipped: tuple[Skipped, ...]
    listings: dict[Path, dict[str, list[str]]] = field(default_factory=dict, compare=False)

    @property
    def references(self) -> list[Photo]:
        """The photos of the reference modality."""
        return [photo for photo in self.photos if photo.is_reference]

    @property
    def others(self) -> list[Photo]:
        """All other photos, which may be partners."""
        return [photo for photo in self.photos if not photo.is_reference]


def take_inventory(root: Path, progress: Progress | None = None) -> Inventory:
    """All files below a folder. SceneError if it cannot be listed, or has no possible photo."""
    if not root.is_dir():
        raise scene_error(root, "not a folder; give the photos' folder")
    photos, skipped = [], []
    files = sorted(visible_files(root), key=lambda path: natural(path.relative_to(root).as_posix()))
    for done, path in enumerate(files):
        if progress is not None:
            progress("reading headers", done, len(files))
        relative = PurePosixPath(path.relative_to(root))
        found: Photo | str = "is a link to a folder, which is not followed"
        if not path.is_dir():
            stamp = stamp_of(path) if path.exists() else None
            found = _inspected(path, relative, stamp) if stamp else inspect(path, relative)
        if isinstance(found, str):
            skipped.append(Skipped(printable(relative.as_posix()), found))
        else:
            photos.append(found)
    if not photos:
        what = "holds no photos"
        if skipped:
            what = (
                f"none of its {len(skipped)} files is a photo that can be read, such as "
                f"{skipped[0].name}, which {skipped[0].reason}"
            )
        raise scene_error(
            root, f"{what}; give the folder with the camera's JPEG, PNG or TIFF files"
        )
    photos, copies = _without_copies(photos)
    photos, replaced = _one_file_per_photo(told_apart(photos, root.resolve().name))
    return Inventory(root, tuple(photos), tuple(skipped + copies + replaced))


@lru_cache(maxsize=20_000)
def _inspected(path: Path, relative: PurePosixPath, stamp: Stamp) -> Photo | str:
    """``inspect``, once until the file changes: ``prepare`` asks again after the estimate."""
    return inspect(path, relative)


def _without_copies(photos: list[Photo]) -> tuple[list[Photo], list[Skipped]]:
    """The photos without copies: of files with the same name and content, as in a backup of the
    card or ``IMG_0001 (1).jpg``, the one with the shortest path is kept.

    Each copy would be a view of its own, and that of a held-out view would be trained on.
    """
    by_name: dict[tuple[str, int, Modality | None], list[Photo]] = {}
    for photo in photos:
        camera, _ = folder_modality(photo.origin.parts[:-1])
        name = _COPY.sub("", composed(photo.path.stem.casefold())) + photo.path.suffix.casefold()
        key = name, photo.path.stat().st_size, camera
        by_name.setdefault(key, []).append(photo)
    copies: dict[Photo, Photo] = {}
    for group in by_name.values():
        originals: list[Photo] = []
        for photo in sorted(group, key=lambda one: len(str(one.origin))):
            first = next((one for one in originals if _same_content(one.path, photo.path)), None)
            if first is None:
                originals.append(photo)
            else:
                copies[photo] = first
    skipped = [Skipped(photo.name, f"is a copy of {first.name}") for photo, first in copies.items()]
    return [photo for photo in photos if photo not in copies], skipped


def _same_content(first: Path, second: Path) -> bool:
    with suppress(OSError):  # the next reader raises the error
        return filecmp.cmp(first, second, shallow=False)
    return False


def _one_file_per_photo(photos: list[Photo]) -> tuple[list[Photo], list[Skipped]]:
    """The best file of each thermal photo; the others are skipped.

    Files of one stem in one folder are the same photo, and so are one that only the maker's tool
    reads and the one file of that stem elsewhere that it was converted to. Where there are RGB
    photos besides, an image that is thermal by its folder or name is the preview of the numbers
    of its stem, or of this and a word, beside it or in another folder for thermal photos.
    """
    has_rgb = not all(photo.is_reference for photo in photos)
    stems = [(_place(photo), composed(photo.origin.name.casefold())) for photo in photos]
    shown = zip(stems, photos, strict=True)
    previews = {stem for stem, photo in shown if has_rgb and _is_preview(photo)}
    by_stem: dict[str, list[Photo]] = {}
    for (place, stem), photo in zip(stems, photos, strict=True):
        if photo.kind in ("numbers", "table") and (place, stem) not in previews:
            short = re.sub(r"[_\-. ][a-z]+$", "", stem)
            stem = short if (place, short) in previews else stem
        by_stem.setdefault(stem, []).append(photo)
    best: dict[Photo, Photo] = {}
    for group in by_stem.values():
        finished = [photo for photo in group if photo.kind in ("numbers", "table")]
        for photo in group:
            beside = [other for other in group if _is_of(other, photo, has_rgb)]
            best[photo] = min([photo, *beside], key=lambda one: one.preference)
            if best[photo].needs_tool and len(finished) == 1:
                best[photo] = finished[0]
    used = {photo: original for original, photo in best.items() if photo is not original}
    kept, skipped = [], []
    for photo in photos:
        if best[photo] is not photo:
            reason = f"the temperatures are taken from {best[photo].name}"
            skipped.append(Skipped(photo.name, reason))
        elif photo in used and used[photo].needs_tool:
            exif = replace(used[photo].exif, orientation=photo.exif.orientation)
            serial = used[photo].serial
            kept.append(replace(photo, origin=used[photo].origin, exif=exif, serial=serial))
        elif photo in used:
            kept.append(replace(photo, origin=used[photo].origin))
        else:
            kept.append(photo)
    return kept, skipped


def _place(photo: Photo) -> tuple[str, ...]:
    """The folders of a photo, but for what says that it is thermal, or its format."""
    folders, formats = folder_modality(photo.origin.parts[:-1])[1], {".csv", *IMAGE_SUFFIXES}
    return tuple(folder for folder in folders if f".{folder.lower()}" not in formats)


def _is_preview(photo: Photo) -> bool:
    """Whether it is a plain image in a folder for thermal photos."""
    named = folder_modality(photo.origin.parts[:-1])[0]
    return photo.is_reference and not photo.is_thermal and named == REFERENCE


def _is_of(other: Photo, photo: Photo, has_rgb: bool) -> bool:
    """Whether two files of one stem show the same."""
    if other.path.parent == photo.path.parent:
        return all(one.is_reference if has_rgb else one.is_thermal for one in (photo, other))
    is_finished = other.kind in ("numbers", "table")
    return has_rgb and is_finished and _is_preview(photo) and _place(other) == _place(photo)
