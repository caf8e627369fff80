"""Pairs from a folder of photos, by the rule that fits most of them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from mrgs.data.files import contained, is_file, on_disk, table_rows
from mrgs.errors import ConfigError, SceneError, printable, scene_error
from mrgs.prepare.contract import Pairing, PhotoPair, Progress, Skipped
from mrgs.prepare.options import PairRule, PrepareOptions
from mrgs.prepare.pairs.cameras import check_cameras, of_one_camera, shifted
from mrgs.prepare.pairs.inventory import NOT_READ, Inventory, take_inventory
from mrgs.prepare.pairs.photo import (
    HEADINGS,
    PARTNER,
    REFERENCE,
    Photo,
    candidate_by_name,
    natural,
    read_stem,
    view_names,
)
from mrgs.prepare.pairs.rules import (
    NEARLY,
    Match,
    Pair,
    by_embedded,
    by_folders,
    by_names,
    by_numbers,
    by_time,
    in_order,
)
from mrgs.scene import Modality
from mrgs.system.wording import counted, shown

_FEWEST_PAIRS = 3
"""With fewer, or with fewer than a tenth of the reference photos, a set that lacks most partners
is used without any."""


def find_pairs(
    photos: Path, options: PrepareOptions | None = None, progress: Progress | None = None
) -> Pairing:
    """The photos of a folder and its subfolders that belong together.

    Of the options, ``pairs`` is the rule: ``names`` compares the names of files (DJI's ``_T`` and
    ``_W``, FLIR's neighbouring numbers, suffixes), or takes the RGB photos embedded in FLIR's
    files; ``folders`` looks for equal names in folders such as ``rgb`` and ``thermal``; ``time``
    compares the times in EXIF; ``auto`` takes the one of these with the most pairs; ``thermal``
    takes the thermal photos only. ``pair_table`` is a CSV file with the pairs, ``rgb,thermal``,
    relative to the folder, instead of a rule. ``camera`` is the model of the thermal camera, where
    the models are equal the size of its photos such as ``640 x 512``, and else its lens such as
    ``45°``.

    Returns:
        The pairs. Every other file, except hidden ones, is in ``skipped`` with a reason.

    Raises:
        SceneError: the folder or the table cannot be read, there are no pairs, or they are of
            different cameras (SeveralCamerasError: of which one can be chosen).
        ConfigError: both a rule and a table, or an invalid tolerance.
    """
    options = options or PrepareOptions()
    rule, table, camera, tolerance_s = (
        options.pairs, options.pair_table, options.camera, options.tolerance_s
    )  # fmt: skip
    if not (math.isfinite(tolerance_s) and tolerance_s >= 0):
        raise ConfigError(
            f"invalid time difference of {tolerance_s:g} s; give 0 s or more",
            options=("tolerance_s",),
        )
    if table is not None and rule != "auto":
        raise ConfigError(
            "a table of pairs and a pairing rule are both given; give one of the two",
            options=("pair_table", "pairs"),
        )
    inventory = take_inventory(photos, progress)
    by_rule = partial(_match, rule=rule, tolerance_s=tolerance_s)
    match = by_table(table, inventory) if table else None
    if camera is not None or match is None:
        inventory = of_one_camera(inventory, camera, by_rule)
    match = match or by_rule(inventory)
    kept = {*inventory.photos}
    pairs = [pair for pair in match.pairs if pair.reference in kept]
    pairs = [pair for pair in pairs if pair.partner or pair.embedded] or pairs
    warnings = (
        *match.warnings,
        *shifted(pairs),
        *check_cameras(pairs, inventory, camera),
        *_left_out(inventory, pairs),
    )
    skipped = [*inventory.skipped, *_unused(inventory, match, pairs)]
    found = [
        PhotoPair(
            name,
            {modality: photo.path for modality, photo in pair.photos.items()},
            pair.embedded,
            {modality: photo.exif for modality, photo in pair.photos.items()},
        )
        for name, pair in zip(_names(pairs), pairs, strict=True)
    ]
    return Pairing(
        tuple(sorted(found, key=lambda pair: natural(pair.name))),
        tuple(sorted(skipped, key=lambda item: natural(item.name))),
        match.rule,
        warnings,
    )


def _left_out(inventory: Inventory, pairs: Sequence[Pair]) -> Iterator[str]:
    """Sentences on files that were probably meant to be used: numbers beside a picture of their
    name, and photos that cannot be read where no others have colours."""
    shades = {pair.reference.origin.name for pair in pairs if not pair.reference.is_thermal}
    used = {pair.reference for pair in pairs}
    finished = [each for each in inventory.references if each.is_thermal and each not in used]
    if passed := [each.name for each in finished if each.origin.name in shades]:
        yield f"{passed[0]} holds numbers, but a picture of its name is used: move that."
    unread = [item.name for item in inventory.skipped if NOT_READ in item.reason]
    if unread and not any(pair.partner or pair.embedded for pair in pairs):
        yield (
            f"{counted(len(unread), 'photo')} cannot be read, such as {printable(unread[0])}, so "
            f"there are no colours: save them as JPEG."
        )


def _names(pairs: Sequence[Pair]) -> list[str]:
    """A name of each pair: its reference photo's, without the camera's suffix."""
    photos = [pair.reference for pair in pairs]
    named = [(each.origin, read_stem(each.origin.name, each.is_thermal).key) for each in photos]
    return view_names([origin.with_name(key) if key else origin for origin, key in named])


def _match(inventory: Inventory, rule: PairRule, tolerance_s: float) -> Match:
    """What the rule finds; with ``auto``, the best. Only the reference photos where no or too few
    partners are there."""
    references, others = inventory.references, inventory.others
    if rule == REFERENCE.name and references:
        return _alone(
            references, dict.fromkeys(others, f"only the {REFERENCE.title} photos are used")
        )
    pairable = min(len(references), len(others))
    best = _best_match(inventory.photos, rule, tolerance_s, pairable)
    count, least = _count(best), max(_FEWEST_PAIRS, len(references) / 10)
    if 2 * max(count, len(others)) < len(references) and count < least:
        found = len(others) + sum(photo.embedded for photo in references)
        doubt = (
            f"There are {len(references)} {REFERENCE.title} photos but only {found} "
            f"{PARTNER.title} photos: only the {REFERENCE.title} photos are used. To use only the "
            f"pairs, remove the other photos, or list the pairs in a CSV file.",
        )
        reason = f"most {REFERENCE.title} photos have no {PARTNER.title} photo"
        return _alone(references, dict.fromkeys(others, reason), doubt if found else ())
    if best is None:
        raise _no_pairs(inventory, rule, tolerance_s)
    return best


def _best_match(
    photos: Sequence[Photo], rule: PairRule, tolerance_s: float, pairable: int
) -> Match | None:
    """The match with the most pairs, the first of equal ones; numbers and times count only where
    names fail for most photos."""
    best: Match | None = None
    if rule in ("auto", "names"):
        best = by_names(photos, tolerance_s)
    if rule in ("auto", "folders"):
        best = max(best, by_folders(photos, tolerance_s), key=_count)
    if rule in ("auto", "names"):
        if 2 * _count(best) <= pairable:
            best = max(best, by_numbers(photos), key=_count)
        embedded = by_embedded(photos)  # smaller than separate photos
        best = embedded if _count(best) < NEARLY * _count(embedded) else best
    if rule == "time" or (rule == "auto" and 2 * _count(best) < pairable):
        best = max(best, by_time(photos, tolerance_s), key=_count)
    return best


def _count(match: Match | None) -> int:
    return 0 if match is None else len(match.pairs)


def _alone(
    references: list[Photo], reasons: dict[Photo, str], warnings: tuple[str, ...] = ()
) -> Match:
    """The reference photos without partners, and why other photos are not used; of several files
    of one photo the best."""
    best: dict[tuple, Photo] = {}
    for photo in sorted(references, key=lambda each: each.preference):
        found = candidate_by_name(photo)
        if (one := best.setdefault((found.key, found.moment), photo)) is not photo:
            reasons[photo] = f"{printable(one.path.name)} is used instead"
    pairs = in_order(Pair(photo) for photo in best.values())
    return Match(pairs, f"Only the {REFERENCE.title} photos are used.", "", reasons, warnings)


def _no_pairs(inventory: Inventory, rule: PairRule, tolerance_s: float) -> SceneError:
    references, others = inventory.references, inventory.others
    options: tuple[str, ...] = ("pair_table",)
    found = f"its {len(references)} {REFERENCE.title} and {len(others)} other photos make no pairs"
    equal_names = f"give them equal names in folders {PARTNER} and {REFERENCE}"
    groups = {REFERENCE.title: references, "other": others}
    timeless = [
        name for name, photos in groups.items() if not any(photo.exif.taken for photo in photos)
    ]
    if not references:
        found = f"none of its {len(inventory.photos)} photos is known to be {REFERENCE.title}"
        why = f"put them into folders named {REFERENCE} and {PARTNER}"
    elif rule == "time" and timeless:
        why = f"the {timeless[0]} photos do not say when they were taken; {equal_names}"
    elif rule == "time":
        why = f"none were taken within {tolerance_s:g} s; give a larger time difference"
        options = ("tolerance_s", *options)
    elif rule == "folders":
        why = "the folders of the two cameras hold no equal names; rename the photos"
    elif rule == "names":
        why = "no names differ only in the camera suffix, such as _T and _W; rename the photos"
    else:
        why = f"neither names nor times show which belong together; {equal_names}"
    why = f"{why}, or list the pairs in a CSV file"
    return scene_error(inventory.root, f"{found}: {why}", options=options)


def _unused(inventory: Inventory, match: Match, pairs: list[Pair]) -> list[Skipped]:
    """All photos that are in no pair, with the reason."""
    used = {photo for pair in pairs for photo in pair.photos.values()}
    reasons = dict.fromkeys(inventory.others, f"has no {REFERENCE.title} photo {match.without}")
    lacking = f"has no {PARTNER.title} photo {match.without}"
    reasons |= dict.fromkeys(inventory.references, lacking)
    alone = f"has no {PARTNER.title} photo, while others do"
    reasons |= {**match.reasons, **{pair.reference: alone for pair in match.pairs}}
    return [Skipped(photo.name, reasons[photo]) for photo in inventory.photos if photo not in used]


_COLUMNS = (PARTNER, REFERENCE)
_EXAMPLE = "write lines such as " + ",".join(f"{modality}/a.jpg" for modality in _COLUMNS)


def by_table(table: Path, inventory: Inventory) -> Match:
    """The pairs in a CSV file: the RGB photo and the thermal photo, relative to the folder of
    photos.

    The RGB photo may be left empty: then it is embedded in the thermal photo's file, or there is
    none. A first line with headings (``rgb``, ``thermal``) gives the order of the columns. Columns
    are separated by semicolons, tabs, commas or blanks; see ``decoded_text`` for the encodings.
    SceneError if the table cannot be read, or a line names something other than two photos of the
    folder.
    """
    photos = {photo.path.resolve(): photo for photo in inventory.photos}
    pairs, used = [], dict[Photo, int]()
    for number, names, is_headed in _rows(table):
        reference = _photo(names[REFERENCE], photos, inventory, table, number)
        partner = None
        if names[PARTNER]:
            partner = _photo(names[PARTNER], photos, inventory, table, number)
            is_swapped = partner.is_thermal and not reference.is_thermal
            names_swap = partner.is_reference and not reference.is_reference
            if is_swapped or (names_swap and not is_headed):
                partner, reference = reference, partner
        for photo in filter(None, (partner, reference)):
            if (before := used.setdefault(photo, number)) != number:
                both = f"lines {before} and {number} both name {photo.name}"
                raise scene_error(table, f"{both}; delete one of them")
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


def _rows(table: Path) -> Iterator[tuple[int, dict[Modality, str], bool]]:
    """Number of the line, the names of its photos by modality, and whether headings say so."""
    columns = {modality: index for index, modality in enumerate(_COLUMNS)}
    has_headings = has_pairs = False
    for number, cells in table_rows(table, _EXAMPLE):
        while len(cells) > 2 and not cells[-1]:
            cells.pop()
        headings = {
            each: index for index, cell in reversed([*enumerate(cells)]) if (each := _heading(cell))
        }
        is_heading = headings.keys() == columns.keys() and not has_pairs
        cells += [""] * (max(columns.values()) + 1 - len(cells))
        if is_heading:
            columns, has_headings = headings, True
        elif cells[0].startswith("# "):
            continue
        elif cells[columns[REFERENCE]] and (has_headings or len(cells) == 2):
            has_pairs = True
            yield number, {each: cells[at] for each, at in columns.items()}, has_headings
        else:
            raise scene_error(
                table,
                f"line {number} does not name an {PARTNER.title} and a {REFERENCE.title} photo; "
                f"{_EXAMPLE}",
            )


def _heading(cell: str) -> Modality | None:
    """The modality that a heading names; None for the name of a photo."""
    words = set() if re.search(r"[./\\]", cell) else {*re.findall("[a-z]+", cell.lower())}
    return next((each for each in (REFERENCE, PARTNER) if words & HEADINGS[each]), None)


def _photo(
    text: str, photos: dict[Path, Photo], inventory: Inventory, table: Path, number: int
) -> Photo:
    try:
        root = inventory.root.resolve()
        path = contained(root, text, table)
        if not is_file(path):
            path = contained(root, on_disk(root, text, inventory.listings), table)
    except SceneError:
        raise scene_error(
            table,
            f"line {number}: {shown(text)} lies outside {inventory.root}; name photos relative to "
            f"that folder",
        ) from None
    if not is_file(path):
        raise scene_error(
            table, f"line {number}: there is no {shown(text)} in {inventory.root}; correct the name"
        )
    if path.resolve() not in photos:
        name = path.relative_to(inventory.root.resolve()).as_posix()
        reasons = (item.reason for item in inventory.skipped if item.name == name)
        why = next(reasons, "is not a photo")
        raise scene_error(table, f"line {number}: {shown(text)} {why}; name another file")
    return photos[path.resolve()]
