"""Pairs that the user has written down."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

from mrgs.data.files import contained, is_file, read_bytes, scene_error, shown
from mrgs.errors import SceneError
from mrgs.prepare.pairs.inventory import Inventory
from mrgs.prepare.pairs.names import composed, natural, printable
from mrgs.prepare.pairs.photo import Photo
from mrgs.prepare.pairs.rules import Match, Pair

_MAX_BYTES = 16 * 2**20
_HEADINGS = (
    {"rgb", "visible", "visual", "color", "colour", "image"},
    {"thermal", "ir", "infrared"},
)
_EXAMPLE = "write lines such as rgb/a.jpg,thermal/a.jpg"


def by_table(table: Path, inventory: Inventory) -> Match:
    """The pairs in a CSV file: the RGB photo and the thermal photo, relative to the folder of
    photos.

    The RGB photo may be left empty: then it lies in the thermal photo's file, or there is none. A
    first line with headings (``rgb``, ``thermal``) tells the order of the columns.

    Raises:
        SceneError: the table cannot be read, or a line names something other than two photos of the
            folder.
    """
    photos = {photo.path.resolve(): photo for photo in inventory.photos}
    pairs, used = [], dict[Photo, int]()
    for number, rgb_text, thermal_text in _rows(table):
        rgb = _photo(rgb_text, photos, inventory, table, number) if rgb_text else None
        thermal = _photo(thermal_text, photos, inventory, table, number)
        for photo in (rgb, thermal):
            if photo is not None and (before := used.setdefault(photo, number)) != number:
                name = inventory.name(photo)
                raise scene_error(
                    table, f"lines {before} and {number} both name {name}; delete one of them"
                )
        if rgb is thermal:
            raise scene_error(
                table,
                f"line {number} names one photo twice; leave out the RGB photo if it lies inside "
                f"the thermal one",
            )
        pairs.append(Pair(rgb, thermal, embedded=rgb is None and thermal.embedded))
    if not pairs:
        raise scene_error(table, f"holds no pairs; {_EXAMPLE}")
    pairs.sort(key=lambda pair: natural(str(pair.thermal.origin)))
    reasons = dict.fromkeys(inventory.photos, f"is not in {printable(table.name)}")
    return Match(tuple(pairs), f"The pairs are those of {printable(table.name)}.", reasons=reasons)


def _rows(table: Path) -> Iterator[tuple[int, str, str]]:
    """Number of the line, RGB photo, thermal photo."""
    data = read_bytes(table, _MAX_BYTES)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    lines = text.splitlines()
    separator = next((sign for sign in ";\t" if any(sign in line for line in lines)), ",")
    columns = (0, 1)
    for number, line in enumerate(lines, 1):
        try:
            cells = [
                cell.strip() for row in csv.reader([line], delimiter=separator) for cell in row
            ]
        except csv.Error as error:
            raise scene_error(
                table, f"line {number} cannot be read ({error}); {_EXAMPLE}"
            ) from None
        if not any(cells):
            continue
        headings = _headings(cells)
        if headings is not None:
            columns = headings
        elif len(cells) != 2 or not cells[columns[1]]:
            raise scene_error(
                table, f"line {number} does not name an RGB and a thermal photo; {_EXAMPLE}"
            )
        else:
            yield number, cells[columns[0]], cells[columns[1]]


def _headings(cells: Sequence[str]) -> tuple[int, int] | None:
    """The columns of the RGB and of the thermal photo, if the cells are headings."""
    words = [cell.lower() for cell in cells]
    found = [
        next((index for index, word in enumerate(words) if word in known), None)
        for known in _HEADINGS
    ]
    return None if len(words) != 2 or None in found else (found[0], found[1])  # type: ignore[return-value]


def _photo(
    text: str, photos: dict[Path, Photo], inventory: Inventory, table: Path, number: int
) -> Photo:
    try:
        path = contained(inventory.root.resolve(), text, table)
    except SceneError:
        raise scene_error(
            table,
            f"line {number}: {shown(text)} lies outside {inventory.root}; name photos relative to "
            f"that folder",
        ) from None
    path = path if is_file(path) else _spelled(path, inventory)
    if not is_file(path):
        raise scene_error(
            table, f"line {number}: there is no {shown(text)} in {inventory.root}; correct the name"
        )
    if path.resolve() not in photos:
        raise scene_error(
            table, f"line {number}: {shown(text)} {_why(path, inventory)}; name another file"
        )
    return photos[path.resolve()]


def _spelled(path: Path, inventory: Inventory) -> Path:
    """The file whose name is the same text in another Unicode form; the path itself if there is
    none."""
    root, wanted = inventory.root.resolve(), composed(str(path))
    names = [photo.path.relative_to(inventory.root).as_posix() for photo in inventory.photos]
    names += [item.name for item in inventory.skipped]
    return next((root / name for name in names if composed(str(root / name)) == wanted), path)


def _why(path: Path, inventory: Inventory) -> str:
    name = path.relative_to(inventory.root.resolve()).as_posix()
    return next((item.reason for item in inventory.skipped if item.name == name), "is no photo")
