"""Pairs listed by the user in a CSV file."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

from mrgs.data.files import contained, decoded_text, is_file, read_bytes, scene_error
from mrgs.errors import SceneError
from mrgs.prepare.pairs.inventory import Inventory, Photo
from mrgs.prepare.pairs.names import HEADINGS, PARTNER, REFERENCE, composed, printable
from mrgs.prepare.pairs.rules import Match, Pair, in_order
from mrgs.scene import Modality
from mrgs.system.wording import shown

_MAX_BYTES = 16 * 2**20
_COLUMNS = (PARTNER, REFERENCE)
_EXAMPLE = "write lines such as " + ",".join(f"{modality}/a.jpg" for modality in _COLUMNS)


def by_table(table: Path, inventory: Inventory) -> Match:
    """The pairs in a CSV file: the RGB photo and the thermal photo, relative to the folder of
    photos.

    The RGB photo may be left empty: then it is embedded in the thermal photo's file, or there is
    none. A first line with headings (``rgb``, ``thermal``) gives the order of the columns. Columns
    are separated by commas, semicolons or tabs; see ``decoded_text`` for the encodings.

    Raises:
        SceneError: the table cannot be read, or a line names something other than two photos of the
            folder.
    """
    photos = {photo.path.resolve(): photo for photo in inventory.photos}
    pairs, used = [], dict[Photo, int]()
    for number, names in _rows(table):
        partner, reference = (
            _photo(names[modality], photos, inventory, table, number) if names[modality] else None
            for modality in _COLUMNS
        )
        assert reference is not None  # an empty name is refused while the lines are read
        for photo in (partner, reference):
            if photo is not None and (before := used.setdefault(photo, number)) != number:
                name = inventory.name(photo)
                raise scene_error(
                    table, f"lines {before} and {number} both name {name}; delete one of them"
                )
        if partner is reference:
            raise scene_error(
                table,
                f"line {number} names one photo twice; leave out the {PARTNER.title} photo if it "
                f"lies inside the {REFERENCE.title} one",
            )
        pairs.append(Pair(reference, partner, partner is None and reference.embedded))
    if not pairs:
        raise scene_error(table, f"holds no pairs; {_EXAMPLE}")
    reasons = dict.fromkeys(inventory.photos, f"is not in {printable(table.name)}")
    rule = f"The pairs are those of {printable(table.name)}."
    return Match(in_order(pairs), rule, reasons=reasons)


def _rows(table: Path) -> Iterator[tuple[int, dict[Modality, str]]]:
    """Number of the line, and the names of its photos by modality."""
    lines = decoded_text(read_bytes(table, _MAX_BYTES)).splitlines()
    separator = next((sign for sign in ";\t" if any(sign in line for line in lines)), ",")
    columns: tuple[Modality, ...] = _COLUMNS
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
        elif len(cells) != 2 or not cells[columns.index(REFERENCE)]:
            raise scene_error(
                table,
                f"line {number} does not name an {PARTNER.title} and a {REFERENCE.title} photo; "
                f"{_EXAMPLE}",
            )
        else:
            yield number, dict(zip(columns, cells, strict=True))


def _headings(cells: Sequence[str]) -> tuple[Modality, ...] | None:
    """The modality of each column, if the cells are headings."""
    found = tuple(
        modality for cell in cells for modality in _COLUMNS if cell.lower() in HEADINGS[modality]
    )
    return found if len(cells) == 2 and set(found) == set(_COLUMNS) else None


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
