"""Opening untrusted files: bounded, and never outside the scene folder."""

from __future__ import annotations

import csv
import errno
import json
import os
import unicodedata
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, TypeAlias

import msgspec

from mrgs.errors import scene_error
from mrgs.system.disk import read_regular
from mrgs.system.wording import shown

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".npy"})
MAX_FILE_BYTES = 4 * 2**30
MAX_JSON_BYTES = 256 * 2**20
MAX_TABLE_BYTES = 16 * 2**20
MAX_MAGNITUDE = 1e7
"""Larger positions, pixel counts and focal lengths are damage: float32 has too few digits."""


def contained(root: Path, relative: str, named_in: Path | str) -> Path:
    """The path ``relative`` below ``root`` (already resolved), which need not exist. SceneError if
    it leaves the folder: as an absolute path, by ``..`` or by a symbolic link."""
    try:
        path = root / relative.replace("\\", "/")
        whole = path.resolve()
        path = path if path.is_relative_to(root) else whole
        outside = not whole.is_relative_to(root)
    except (ValueError, OSError, RuntimeError):  # a null byte, a long name, a loop of links
        raise scene_error(named_in, f"{shown(relative)} is not a usable path; correct it") from None
    if outside:
        raise scene_error(
            named_in,
            f"the path {shown(relative)} leaves the scene folder; put the file inside, and name "
            f"it relative to it",
        )
    return path


def is_file(path: Path | os.DirEntry[str]) -> bool:
    """``Path.is_file``, False for names that the file system refuses and links to themselves."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def visible_files(folder: Path) -> Iterator[Path]:
    """All files below a folder, and links to folders, which are not followed; without hidden ones,
    which macOS leaves on memory cards. SceneError if a folder cannot be listed."""

    def refuse(error: OSError) -> None:
        raise scene_error(
            error.filename, f"cannot be read ({error.strerror}); give a folder that is readable"
        ) from None

    for parent, folders, names in os.walk(folder, onerror=refuse):
        folders[:] = [name for name in folders if not name.startswith(".")]
        linked = [name for name in folders if os.path.islink(os.path.join(parent, name))]
        for name in [*names, *linked]:
            if not name.startswith("."):
                yield Path(parent, name)


def read_bytes(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """The file's content. SceneError if it cannot be read, is not a regular file, or is larger than
    ``limit`` bytes."""
    try:
        return read_regular(path, limit)
    except OSError as error:
        problem = f"cannot be read ({error.strerror}); check that it is the right file and readable"
        raise scene_error(path, problem) from None


def decoded_text(data: bytes) -> str:
    """The text of a file that a spreadsheet or a camera's program wrote: UTF-16 with a byte-order
    mark (Excel's "Unicode text") or zeros behind its first letters, UTF-8, else Windows-1252."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")) or 0 in data[1:4:2]:
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")


def table_rows(table: Path, remedy: str) -> Iterator[tuple[int, list[str]]]:
    """Number and cells of each line of a table that is not empty; columns are separated by
    semicolons, tabs, commas or blanks. SceneError, with the remedy, if a line cannot be read."""
    lines = decoded_text(read_bytes(table, MAX_TABLE_BYTES)).splitlines()
    separator = next((sign for sign in ";\t," if any(sign in line for line in lines)), " ")
    for number, line in enumerate(lines, 1):
        reader = csv.reader([line.strip(" ")], delimiter=separator, skipinitialspace=True)
        try:
            cells = [cell.strip() for cell in next(reader, [])]
        except csv.Error as error:
            raise scene_error(table, f"line {number} cannot be read ({error}); {remedy}") from None
        if any(cells) and not cells[0].lower().startswith("sep="):  # by Excel
            yield number, cells


def read_json_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file. SceneError if it cannot be read, or is no JSON object."""
    try:
        content = json.loads(read_bytes(path, MAX_JSON_BYTES))
    except (ValueError, RecursionError) as error:
        raise scene_error(path, f"is not valid JSON ({error}); repair or export it again") from None
    if not isinstance(content, dict):
        raise scene_error(
            path, f"holds {shown(content)} where a JSON object {{...}} is expected; export it again"
        )
    return content


Number: TypeAlias = Annotated[float, msgspec.Meta(ge=-MAX_MAGNITUDE, le=MAX_MAGNITUDE)]
"""A finite number, no larger in magnitude than any real capture needs."""


def composed(text: str) -> str:
    """The text in one Unicode form (NFC): macOS may write ``ü`` as two characters."""
    return unicodedata.normalize("NFC", text)


def on_disk(
    root: Path, relative: str, listings: dict[Path, dict[str, list[str]]] | None = None
) -> str:
    """A path below ``root`` as its folders and its file are named, where these names differ from it
    in their case or Unicode form. ``listings`` keeps the names in folders for further calls."""
    listings, parts = {} if listings is None else listings, list[str]()
    for part in relative.replace("\\", "/").split("/"):
        if (folder := root.joinpath(*parts)) not in listings:
            listings[folder] = {}
            for entry in _entries(folder):
                listings[folder].setdefault(composed(entry.name).casefold(), []).append(entry.name)
        same = listings[folder].get(composed(part).casefold(), [])
        parts.append(same[0] if len(same) == 1 else part)
    return "/".join(parts)


def without_image_suffix(name: str) -> str:
    """A name or a path without its image extension; other dots in it are kept."""
    stem, dot, suffix = name.rpartition(".")
    is_image = stem.rpartition("/")[2] and f".{suffix.lower()}" in IMAGE_SUFFIXES
    return stem if dot and is_image else name


@dataclass(frozen=True)
class _Listing:
    """The images of one folder inside the scene: by name, whether an image is a symbolic link; and
    their names by what precedes the extension, the best format first."""

    folder: Path
    links: Mapping[str, bool]
    by_stem: Mapping[str, list[str]]


_FORMATS = (".tiff", ".tif", ".png", ".jpg", ".jpeg", ".npy")
"""Formats of images in order of preference, if several have one name: a JPEG is often a preview."""


class ImageFinder:
    """Finds image files in the scene's folder by stem; each folder is listed once. Unicode forms of
    a name are the same, and so are cases of a folder's."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._listings: dict[str, _Listing] = {}

    def find(self, relative: str, named_in: Path | str) -> Path | None:
        """The image ``relative``, or the one in the same folder that differs in the extension only;
        None if absent. SceneError if the path leaves the scene's folder."""
        if relative[:1] in ("/", "\\"):
            relative = contained(self._root, relative, named_in).relative_to(self._root).as_posix()
        folder, _, name = relative.replace("\\", "/").rpartition("/")
        if not name or "\0" in name:
            contained(self._root, relative, named_in)
            return None
        if folder not in self._listings:
            contained(self._root, relative, named_in)
        listing = self._listing(folder, named_in)
        if name not in listing.links:
            same = listing.by_stem.get(composed(without_image_suffix(name)), [])
            name = min(same, key=lambda each: composed(each) != composed(name), default="")
        return self._path(listing, name, named_in) if name else None

    def find_mask(self, folder: str, image: str, named_in: Path | str) -> Path | None:
        """The mask of an image in a folder: of the same stem, or COLMAP's ``image.jpg.png``."""
        if not self._listing(folder, named_in).links:
            return None
        return self.find(f"{folder}/{image}", named_in) or self.find(
            f"{folder}/{image}.png", named_in
        )

    def tree(self, folder: Path) -> dict[str, Path]:
        """Sorted images in ``folder`` and below: path below it without extension -> file.
        SceneError if a folder cannot be listed, or an image leads out of the scene's folder."""
        found: dict[str, Path] = {}
        files = [*visible_files(folder)]
        linked = [path for path in files if path.is_dir()]
        for directory in dict.fromkeys([*(path.parent for path in files), *linked]):
            listing = self._listing(directory.relative_to(self._root).as_posix(), folder)
            below = composed(directory.relative_to(folder).as_posix())
            for stem, names in listing.by_stem.items():
                key = (PurePosixPath(below) / stem).as_posix()
                found[key] = self._path(listing, names[0], folder)
        return {key: found[key] for key in sorted(found)}

    def _path(self, listing: _Listing, name: str, named_in: Path | str) -> Path:
        """An image of a listing; one that is a link must not lead out of the scene's folder."""
        path = listing.folder / name
        if listing.links[name]:
            return contained(self._root, path.relative_to(self._root).as_posix(), named_in)
        return path

    def _listing(self, folder: str, named_in: Path | str) -> _Listing:
        if folder not in self._listings:
            path = contained(self._root, folder, named_in)
            entries = _entries(path)
            if not entries:
                path = contained(self._root, on_disk(self._root, folder), named_in)
                entries = _entries(path)
            links: dict[str, bool] = {}
            by_stem: dict[str, list[str]] = {}
            for entry in entries:
                stem = without_image_suffix(entry.name)
                if stem != entry.name and entry.name[0] != "." and is_file(entry):
                    links[entry.name] = entry.is_symlink()
                    by_stem.setdefault(composed(stem), []).append(entry.name)
            for names in by_stem.values():
                names.sort(key=lambda name: _FORMATS.index(Path(name).suffix.lower()))
            self._listings[folder] = _Listing(path, links, by_stem)
        return self._listings[folder]


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    """The entries of a folder, by name; none if there is no such folder."""
    try:
        with os.scandir(folder) as entries:
            return sorted(entries, key=lambda entry: entry.name)
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ENOTDIR, errno.ENAMETOOLONG):
            return []
        what = "permissions" if isinstance(error, PermissionError) else "name"
        raise scene_error(folder, f"cannot be read ({error.strerror}); check its {what}") from None
