"""From a folder to pairs: the rule that fits most photos is taken, and said."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

from mrgs.data.files import scene_error
from mrgs.errors import ConfigError, SceneError
from mrgs.prepare.contract import LeftOut, Pairing, PhotoPair
from mrgs.prepare.pairs.cameras import check_cameras
from mrgs.prepare.pairs.inventory import Inventory, take_stock
from mrgs.prepare.pairs.names import natural, read_stem, view_names
from mrgs.prepare.pairs.photo import Photo
from mrgs.prepare.pairs.rules import (
    NEARLY,
    Couple,
    Match,
    by_embedded,
    by_folders,
    by_names,
    by_numbers,
    by_time,
    roles,
)
from mrgs.prepare.pairs.table import by_table

Rule = Literal["auto", "names", "folders", "time", "thermal"]

_FEWEST_PAIRS = 3
"""With fewer, or with fewer than a tenth of the thermal photos, a set of mostly thermal photos has
no RGB photos."""

_TABLE_HINT = "or list the pairs in a CSV file and give it with --pair-table"


def find_pairs(
    photos: Path, *, rule: Rule = "auto", table: Path | None = None, tolerance_s: float = 2.0
) -> Pairing:
    """The photos of a folder and its subfolders that belong together.

    Args:
        photos: the folder.
        rule: ``names`` compares the names of files (DJI's ``_T`` and ``_W``, FLIR's neighbouring
            numbers, suffixes), or takes the visible photos inside FLIR's files; ``folders`` looks
            for equal names in folders such as ``rgb`` and ``thermal``; ``time`` compares the times
            in EXIF; ``auto`` takes the one of these that pairs most; ``thermal`` takes the thermal
            photos alone, whatever RGB photos there are.
        table: a CSV file with the pairs, ``rgb,thermal``, relative to the folder; instead of a
            rule.
        tolerance_s: photos farther apart in time are no pair, seconds.

    Returns:
        The pairs. Every other file, hidden ones aside, is in ``left_out`` with a reason.

    Raises:
        SceneError: the folder or the table cannot be read, there are no pairs, or they are of
            different cameras.
        ConfigError: a rule beside a table, or a tolerance that is no time.
    """
    if not (math.isfinite(tolerance_s) and tolerance_s >= 0):
        raise ConfigError(
            f"a pair's photos cannot lie {tolerance_s:g} s apart; give a time of 0 s or more"
        )
    if table is not None and rule != "auto":
        raise ConfigError(
            "a table of pairs and another way to pair are both given; give one of the two"
        )
    stock = take_stock(photos)
    match = by_table(table, stock) if table is not None else _match(stock, rule, tolerance_s)
    couples, bare = _with_rgb(match.couples)
    warnings = (*match.warnings, *check_cameras(couples, stock))
    names = view_names(
        [couple.thermal.shot.with_name(_view_key(couple.thermal)) for couple in couples]
    )
    pairs = [
        PhotoPair(name, None if rgb is None else rgb.path, thermal.path, inside)
        for name, (rgb, thermal, inside) in zip(names, couples, strict=True)
    ]
    left_out = [*stock.left_out, *_unused(stock, match, couples, bare)]
    return Pairing(
        tuple(sorted(pairs, key=lambda pair: natural(pair.name))),
        tuple(sorted(left_out, key=lambda item: natural(item.name))),
        match.rule,
        warnings,
    )


def _view_key(thermal: Photo) -> str:
    """What a view is called: its thermal photo's name without the mark of the camera."""
    return read_stem(thermal.shot.name, thermal.is_thermal).key or thermal.shot.name


def _match(stock: Inventory, rule: Rule, tolerance_s: float) -> Match:
    """What the rule finds; with ``auto``, the best."""
    rgb, thermal = roles(stock.photos, stock.root.resolve().name)
    if rule == "thermal" and thermal:
        return _alone(thermal, dict.fromkeys(rgb, "the thermal photos are used alone"))
    best = _best_match(stock, rule, tolerance_s, min(len(rgb), len(thermal)))
    pairs = _count(best)
    if 2 * max(pairs, len(rgb)) < len(thermal) and pairs < max(_FEWEST_PAIRS, len(thermal) / 10):
        return _mostly_thermal(rgb, thermal)
    if best is None:
        raise _no_pairs(stock, rgb, thermal, rule, tolerance_s)
    return best


def _best_match(stock: Inventory, rule: Rule, tolerance_s: float, pairable: int) -> Match | None:
    """The most pairs; numbers and times are asked only where names say nothing about most of the
    photos."""
    photos, root_name = stock.photos, stock.root.resolve().name
    best: Match | None = None
    if rule in ("auto", "names"):
        best = by_names(photos, tolerance_s)
    if rule in ("auto", "folders"):
        best = _larger(best, by_folders(photos, root_name, tolerance_s))
    if rule in ("auto", "names"):
        if 2 * _count(best) <= pairable:
            best = _larger(best, by_numbers(photos))
        best = _unless_nearly(best, by_embedded(photos))
    if rule == "time" or (rule == "auto" and 2 * _count(best) < pairable):
        best = _larger(best, by_time(photos, root_name, tolerance_s))
    return best


def _count(match: Match | None) -> int:
    return 0 if match is None else len(match.couples)


def _larger(first: Match | None, second: Match | None) -> Match | None:
    """The one with more pairs; the first if they are equal."""
    return second if _count(second) > _count(first) else first


def _unless_nearly(beside: Match | None, inside: Match | None) -> Match | None:
    """Photos in files of their own are larger than those inside the thermal ones: a few may be
    missing."""
    return inside if _count(beside) < NEARLY * _count(inside) else beside


def _mostly_thermal(rgb: list[Photo], thermal: list[Photo]) -> Match:
    """The thermal photos alone, where there are no RGB photos, or too few to be worth the
    others."""
    others = len(rgb) + sum(photo.embedded for photo in thermal)
    doubt = (
        f"There are {len(thermal)} thermal photos, yet only {others} in visible light: the "
        f"thermal photos are used "
        "alone. To use the pairs alone, remove the other photos, or list the pairs in a CSV file "
        "(--pair-table).",
    )
    reasons = dict.fromkeys(rgb, "most thermal photos have no RGB photo")
    return _alone(thermal, reasons, doubt if others else ())


def _alone(
    thermal: list[Photo], reasons: dict[Photo, str], warnings: tuple[str, ...] = ()
) -> Match:
    """The thermal photos without RGB photos, and why those are not used."""
    couples = tuple(Couple(None, photo) for photo in thermal)
    return Match(couples, "The thermal photos are used alone.", "", reasons, warnings)


def _no_pairs(
    stock: Inventory, rgb: list[Photo], thermal: list[Photo], rule: Rule, tolerance_s: float
) -> SceneError:
    count = len(stock.photos)
    if not thermal:
        return scene_error(
            stock.root,
            f"none of its {count} photos can be told to be thermal; put them into folders named "
            f"thermal and rgb, "
            f"{_TABLE_HINT}",
        )
    found = f"its {len(thermal)} thermal and {len(rgb)} other photos make no pairs"
    if rule == "time" and not any(photo.exif.taken for photo in thermal):
        return scene_error(
            stock.root,
            f"{found}: the thermal photos do not say when they were taken; {_HINT_NO_TIME}",
        )
    if rule == "time" and not any(photo.exif.taken for photo in rgb):
        return scene_error(
            stock.root,
            f"{found}: the other photos do not say when they were taken; {_HINT_NO_TIME}",
        )
    if rule == "time":
        why = f"none were taken within {tolerance_s:g} s; give more with --tolerance"
    elif rule == "folders":
        why = "the folders of the two cameras hold no equal names; rename the photos"
    elif rule == "names":
        why = "no names differ only in the camera's mark, such as _T and _W; rename the photos"
    else:
        why = (
            "neither names nor times tell which belong together; give them equal names in "
            "folders rgb and thermal"
        )
    return scene_error(stock.root, f"{found}: {why}, {_TABLE_HINT}")


_HINT_NO_TIME = (
    "give them equal names in folders rgb and thermal, or list the pairs in a CSV "
    "file (--pair-table)"
)


def _with_rgb(couples: tuple[Couple, ...]) -> tuple[list[Couple], list[Couple]]:
    """Those with an RGB photo, and those without; if none has one, all are used."""
    with_rgb = [couple for couple in couples if couple.rgb is not None or couple.inside]
    if not with_rgb:
        return list(couples), []
    return with_rgb, [couple for couple in couples if couple not in with_rgb]


def _unused(
    stock: Inventory, match: Match, couples: list[Couple], bare: list[Couple]
) -> list[LeftOut]:
    """All photos that are in no pair, with the reason."""
    used = {photo for couple in couples for photo in couple[:2]}
    alone = {couple.thermal: "has no RGB photo, while others do" for couple in bare}
    rgb, _ = roles(stock.photos, stock.root.resolve().name)
    wanted = dict.fromkeys(rgb, "thermal")
    reasons = {
        photo: f"has no {wanted.get(photo, 'RGB')} photo {match.without}" for photo in stock.photos
    }
    reasons |= {**match.reasons, **alone}
    return [
        LeftOut(stock.name(photo), reasons[photo]) for photo in stock.photos if photo not in used
    ]
