"""From a folder to pairs: the rule that fits most photos is taken."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

from mrgs.data.files import scene_error
from mrgs.errors import ConfigError, SceneError
from mrgs.prepare.contract import Pairing, PhotoPair, Skipped
from mrgs.prepare.pairs.cameras import check_cameras
from mrgs.prepare.pairs.inventory import Inventory, take_inventory
from mrgs.prepare.pairs.names import natural, read_stem, view_names
from mrgs.prepare.pairs.photo import Photo
from mrgs.prepare.pairs.rules import (
    NEARLY,
    Match,
    Pair,
    by_embedded,
    by_folders,
    by_names,
    by_numbers,
    by_time,
    roles,
)
from mrgs.prepare.pairs.table import by_table
from mrgs.scene import RGB, THERMAL

Rule = Literal["auto", "names", "folders", "time", "thermal"]

_FEWEST_PAIRS = 3
"""With fewer, or with fewer than a tenth of the thermal photos, a set of mostly thermal photos has
no RGB photos."""


def find_pairs(
    photos: Path, *, rule: Rule = "auto", table: Path | None = None, tolerance_s: float = 2.0
) -> Pairing:
    """The photos of a folder and its subfolders that belong together.

    Args:
        photos: the folder.
        rule: ``names`` compares the names of files (DJI's ``_T`` and ``_W``, FLIR's neighbouring
            numbers, suffixes), or takes the RGB photos embedded in FLIR's files; ``folders`` looks
            for equal names in folders such as ``rgb`` and ``thermal``; ``time`` compares the times
            in EXIF; ``auto`` takes the one of these with the most pairs; ``thermal`` takes the
            thermal photos only.
        table: a CSV file with the pairs, ``rgb,thermal``, relative to the folder; instead of a
            rule.
        tolerance_s: maximum time difference within a pair, seconds.

    Returns:
        The pairs. Every other file, except hidden ones, is in ``skipped`` with a reason.

    Raises:
        SceneError: the folder or the table cannot be read, there are no pairs, or they are of
            different cameras.
        ConfigError: both a rule and a table, or an invalid tolerance.
    """
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
    inventory = take_inventory(photos)
    if table is not None:
        match = by_table(table, inventory)
    else:
        match = _match(inventory, rule, tolerance_s)
    pairs, without_rgb = _with_rgb(match.pairs)
    warnings = (*match.warnings, *check_cameras(pairs, inventory))
    names = view_names([pair.thermal.origin.with_name(_key(pair.thermal)) for pair in pairs])
    found = [_photo_pair(name, pair) for name, pair in zip(names, pairs, strict=True)]
    skipped = [*inventory.skipped, *_unused(inventory, match, pairs, without_rgb)]
    return Pairing(
        tuple(sorted(found, key=lambda pair: natural(pair.name))),
        tuple(sorted(skipped, key=lambda item: natural(item.name))),
        match.rule,
        warnings,
    )


def _photo_pair(name: str, pair: Pair) -> PhotoPair:
    photos = {THERMAL: pair.thermal} if pair.rgb is None else {RGB: pair.rgb, THERMAL: pair.thermal}
    return PhotoPair(
        name,
        {modality: photo.path for modality, photo in photos.items()},
        pair.embedded,
        {modality: photo.exif for modality, photo in photos.items()},
    )


def _key(thermal: Photo) -> str:
    """Name of a view: that of its thermal photo without the camera suffix."""
    return read_stem(thermal.origin.name, thermal.is_thermal).key or thermal.origin.name


def _match(inventory: Inventory, rule: Rule, tolerance_s: float) -> Match:
    """What the rule finds; with ``auto``, the best."""
    rgb, thermal = roles(inventory.photos, inventory.root.resolve().name)
    if rule == "thermal" and thermal:
        return _alone(thermal, dict.fromkeys(rgb, "only the thermal photos are used"))
    best = _best_match(inventory, rule, tolerance_s, min(len(rgb), len(thermal)))
    count = _count(best)
    if 2 * max(count, len(rgb)) < len(thermal) and count < max(_FEWEST_PAIRS, len(thermal) / 10):
        return _mostly_thermal(rgb, thermal)
    if best is None:
        raise _no_pairs(inventory, rgb, thermal, rule, tolerance_s)
    return best


def _best_match(
    inventory: Inventory, rule: Rule, tolerance_s: float, pairable: int
) -> Match | None:
    """The match with the most pairs; numbers and times count only where names fail for most
    photos."""
    photos, root_name = inventory.photos, inventory.root.resolve().name
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
    return 0 if match is None else len(match.pairs)


def _larger(first: Match | None, second: Match | None) -> Match | None:
    """The one with more pairs; the first if they are equal."""
    return second if _count(second) > _count(first) else first


def _unless_nearly(separate: Match | None, embedded: Match | None) -> Match | None:
    """Separate RGB photos are larger than embedded ones, so they win even if a few are missing."""
    return embedded if _count(separate) < NEARLY * _count(embedded) else separate


def _mostly_thermal(rgb: list[Photo], thermal: list[Photo]) -> Match:
    """Only the thermal photos, as there are no or too few RGB photos."""
    others = len(rgb) + sum(photo.embedded for photo in thermal)
    doubt = (
        f"There are {len(thermal)} thermal photos but only {others} RGB photos: only the thermal "
        f"photos are used. To use only the pairs, remove the other photos, or list the pairs in a "
        f"CSV file.",
    )
    reasons = dict.fromkeys(rgb, "most thermal photos have no RGB photo")
    return _alone(thermal, reasons, doubt if others else ())


def _alone(
    thermal: list[Photo], reasons: dict[Photo, str], warnings: tuple[str, ...] = ()
) -> Match:
    """The thermal photos without RGB photos, and why those are not used."""
    pairs = tuple(Pair(None, photo) for photo in thermal)
    return Match(pairs, "Only the thermal photos are used.", "", reasons, warnings)


def _no_pairs(
    inventory: Inventory, rgb: list[Photo], thermal: list[Photo], rule: Rule, tolerance_s: float
) -> SceneError:
    options: tuple[str, ...] = ("pair_table",)
    found = f"its {len(thermal)} thermal and {len(rgb)} other photos make no pairs"
    equal_names = "give them equal names in folders rgb and thermal"
    timeless = [name for name, photos in (("thermal", thermal), ("other", rgb))
                if not any(photo.exif.taken for photo in photos)]  # fmt: skip
    if not thermal:
        found = f"none of its {len(inventory.photos)} photos is known to be thermal"
        why = "put them into folders named thermal and rgb"
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


def _with_rgb(pairs: tuple[Pair, ...]) -> tuple[list[Pair], list[Pair]]:
    """Those with an RGB photo, and those without; if none has one, all are used."""
    with_rgb = [pair for pair in pairs if pair.rgb is not None or pair.embedded]
    if not with_rgb:
        return list(pairs), []
    return with_rgb, [pair for pair in pairs if pair not in with_rgb]


def _unused(
    inventory: Inventory, match: Match, pairs: list[Pair], bare: list[Pair]
) -> list[Skipped]:
    """All photos that are in no pair, with the reason."""
    used = {photo for pair in pairs for photo in pair[:2]}
    alone = {pair.thermal: "has no RGB photo, while others do" for pair in bare}
    rgb, _ = roles(inventory.photos, inventory.root.resolve().name)
    wanted = dict.fromkeys(rgb, "thermal")
    reasons = {
        photo: f"has no {wanted.get(photo, 'RGB')} photo {match.without}"
        for photo in inventory.photos
    }
    reasons |= {**match.reasons, **alone}
    return [
        Skipped(inventory.name(photo), reasons[photo])
        for photo in inventory.photos
        if photo not in used
    ]
