"""The files of a folder of photos: possible photos, and why the others are skipped."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath

from mrgs.data.files import scene_error, visible_files
from mrgs.prepare.cache import Stamp, digest, stamp_of
from mrgs.prepare.contract import Progress, Skipped
from mrgs.prepare.pairs.names import composed, folder_modality, natural, printable
from mrgs.prepare.pairs.photo import PREFERENCE, Photo, inspect
from mrgs.scene import Modality

_REMEMBERED = 20_000
"""Files whose headers a process remembers: ``prepare`` asks for them again after its duration was
estimated."""


@dataclass(frozen=True)
class Inventory:
    """The photos of a folder, one file for each moment and camera.

    Attributes:
        root: the folder.
        photos: in natural order of their paths.
        skipped: all other files; hidden ones are not counted.
    """

    root: Path
    photos: tuple[Photo, ...]
    skipped: tuple[Skipped, ...]

    def name(self, photo: Photo) -> str:
        """The path of a photo's file for messages: below the folder."""
        return below(self.root, photo.path)


def below(root: Path, path: Path) -> str:
    """A path below a folder for messages, with slashes on every system."""
    return printable(path.relative_to(root).as_posix())


def take_inventory(root: Path, progress: Progress | None = None) -> Inventory:
    """All files below a folder.

    Args:
        root: the folder.
        progress: called with a step's name, the number of files that are done, and of all.

    Raises:
        SceneError: the folder cannot be listed, or holds no file that can be a photo.
    """
    if not root.is_dir():
        raise scene_error(root, "not a folder; give the photos' folder")
    photos, skipped = [], []
    files = sorted(visible_files(root), key=lambda path: natural(path.relative_to(root).as_posix()))
    for done, path in enumerate(files):
        if progress is not None:
            progress("reading headers", done, len(files))
        relative = PurePosixPath(path.relative_to(root))
        found = (
            "is a link to a folder, which is not followed"
            if path.is_dir()
            else _inspected(path, relative)
        )
        if isinstance(found, str):
            skipped.append(Skipped(below(root, path), found))
        else:
            photos.append(found)
    if not photos:
        what = (
            f"none of its {len(skipped)} files is a photo that can be read"
            if skipped
            else "holds no photos"
        )
        first = f", such as {skipped[0].name}, which {skipped[0].reason}" if skipped else ""
        raise scene_error(
            root, f"{what}{first}; give the folder with the camera's JPEG, PNG or TIFF files"
        )
    photos, copies = _without_copies(root, photos)
    kept, replaced = _one_file_per_photo(root, photos)
    return Inventory(root, tuple(kept), tuple(skipped + copies + replaced))


def _inspected(path: Path, relative: PurePosixPath) -> Photo | str:
    """What ``inspect`` finds; a file is read once by a process, until it changes."""
    try:
        stamp = stamp_of(path)
    except OSError:
        return inspect(path, relative)
    return _inspected_once(path, relative, stamp)


@lru_cache(maxsize=_REMEMBERED)
def _inspected_once(path: Path, relative: PurePosixPath, stamp: Stamp) -> Photo | str:
    return inspect(path, relative)


def _without_copies(root: Path, photos: list[Photo]) -> tuple[list[Photo], list[Skipped]]:
    """Of files of one name that hold the same bytes, as in a backup of the card, the one with the
    shortest path.

    Each copy would be a view of its own, and that of a held-out view would be trained on.
    """
    by_name: dict[tuple[str, int, Modality | None], list[Photo]] = {}
    for photo in photos:
        camera, _ = folder_modality(photo.origin.parts[:-1])
        key = composed(photo.path.name.casefold()), photo.path.stat().st_size, camera
        by_name.setdefault(key, []).append(photo)
    originals: dict[Photo, Photo] = {}
    for group in by_name.values():
        firsts: dict[str, Photo] = {}
        for photo in sorted(group, key=_length) if len(group) > 1 else ():
            content = digest(photo.path)
            if content:
                originals[photo] = firsts.setdefault(content, photo)
    copies = {photo: first for photo, first in originals.items() if first is not photo}
    skipped = [
        Skipped(below(root, photo.path), f"is a copy of {below(root, first.path)}")
        for photo, first in copies.items()
    ]
    return [photo for photo in photos if photo not in copies], skipped


def _length(photo: Photo) -> int:
    return len(str(photo.origin))


def _one_file_per_photo(root: Path, photos: list[Photo]) -> tuple[list[Photo], list[Skipped]]:
    """Of files that hold the same thermal photo, the best; the others are skipped.

    Files of one stem in one folder hold the same photo, and so do a DJI R-JPEG and the one file of
    that stem elsewhere that it was converted to.
    """
    by_stem: dict[str, list[Photo]] = {}
    for photo in photos:
        by_stem.setdefault(composed(photo.origin.name.casefold()), []).append(photo)
    best: dict[Photo, Photo] = {}
    for group in by_stem.values():
        finished = [photo for photo in group if photo.kind in ("numbers", "table")]
        for photo in group:
            beside = [
                other
                for other in group
                if other.path.parent == photo.path.parent and _same(photo, other)
            ]
            best[photo] = min([photo, *beside], key=lambda one: PREFERENCE.index(one.kind))
            if best[photo].kind == "dji" and len(finished) == 1:
                best[photo] = finished[0]
    used = {photo: original for original, photo in best.items() if photo is not original}
    kept, skipped = [], []
    for photo in photos:
        if best[photo] is not photo:
            reason = f"the temperatures are taken from {below(root, best[photo].path)}"
            skipped.append(Skipped(below(root, photo.path), reason))
        elif photo in used and used[photo].kind == "dji":
            exif = replace(used[photo].exif, orientation=photo.exif.orientation)
            serial = used[photo].serial
            kept.append(replace(photo, origin=used[photo].origin, exif=exif, serial=serial))
        else:
            kept.append(photo)
    return kept, skipped


def _same(photo: Photo, other: Photo) -> bool:
    """Whether both can hold the same thermal photo; a photo in visible light may share its stem."""
    return photo.is_thermal and other.is_thermal
