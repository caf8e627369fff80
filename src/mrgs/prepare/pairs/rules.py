"""Rules that pair photos. Each returns a match; ``find`` chooses among them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import PurePosixPath
from typing import NamedTuple

from mrgs.prepare.pairs.clocks import ClockOffset, clock_offset, match_times
from mrgs.prepare.pairs.names import (
    RGB_MARKS,
    Role,
    composed,
    folder_role,
    natural,
    printable,
    read_stem,
)
from mrgs.prepare.pairs.photo import PREFERENCE, Photo

_NEIGHBOUR_S = 10.0
"""Photos with neighbouring numbers that were taken farther apart in time, seconds, do not belong
together."""

NEARLY = 0.9
"""A better camera is taken even if another one has a few photos more: down to this share of the
most."""


class Pair(NamedTuple):
    """A thermal photo, and the RGB photo of the same moment: a file, embedded, or missing."""

    rgb: Photo | None
    thermal: Photo
    embedded: bool = False


@dataclass(frozen=True)
class Match:
    """What a rule finds.

    Attributes:
        pairs: in natural order of the thermal photos.
        rule: one sentence.
        without: what a photo without partner lacks; ends the reason "has no RGB photo ...".
        reasons: why a photo is not used, where that needs another sentence.
        warnings: sentences that the user should read.
    """

    pairs: tuple[Pair, ...]
    rule: str
    without: str = ""
    reasons: Mapping[Photo, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


class Candidate(NamedTuple):
    """A photo with what its name says; photos of one moment have the same key."""

    photo: Photo
    role: Role | None
    key: str
    mark: str
    moment: datetime | None


def candidate_by_name(photo: Photo) -> Candidate:
    """Camera by content and file name; the folder is part of the key."""
    facts = read_stem(photo.origin.name, photo.is_thermal)
    key = composed("/".join([*photo.origin.parts[:-1], facts.key]).casefold())
    return Candidate(
        photo, "thermal" if photo.is_thermal else facts.role, key, facts.mark, facts.moment
    )


def candidate_by_folder(photo: Photo, root_name: str) -> Candidate:
    """Camera by content and folder; the folder that names the camera is not part of the key."""
    facts = read_stem(photo.origin.name, photo.is_thermal)
    role, rest = folder_role([root_name, *photo.origin.parts[:-1]])
    key = composed("/".join([*rest, facts.key]).casefold())
    return Candidate(photo, "thermal" if photo.is_thermal else role, key, facts.mark, facts.moment)


def roles(photos: Sequence[Photo], root_name: str) -> tuple[list[Photo], list[Photo]]:
    """All RGB and all thermal photos: by content, else by the folder, else by the name; what is
    left is RGB."""
    rgb: list[Photo] = []
    thermal: list[Photo] = []
    for photo in photos:
        role = candidate_by_folder(photo, root_name).role or candidate_by_name(photo).role
        (thermal if role == "thermal" else rgb).append(photo)
    return rgb, thermal


def by_names(photos: Sequence[Photo], tolerance_s: float) -> Match | None:
    """``DJI_0001_T`` and ``DJI_0001_W``, ``a_thermal`` and ``a_rgb``, and so on, in one folder."""
    pairs, reasons = _by_keys([candidate_by_name(photo) for photo in photos], tolerance_s)
    if not pairs:
        return None
    rgb, thermal, _ = pairs[0]
    example = (
        ""
        if rgb is None
        else f", such as {printable(rgb.path.name)} and {printable(thermal.path.name)}"
    )
    return Match(
        pairs,
        f"The names of a pair differ only in the camera suffix{example}.",
        "of its name",
        reasons,
    )


def by_folders(photos: Sequence[Photo], root_name: str, tolerance_s: float) -> Match | None:
    """Equal names in folders such as ``rgb`` and ``thermal``, in equal folders around these, or
    else unique."""
    candidates = [candidate_by_folder(photo, root_name) for photo in photos]
    pairs, reasons = _by_keys(candidates, tolerance_s)
    done = {*reasons, *(photo for pair in pairs for photo in pair[:2])}
    marks = {
        candidate.mark
        for candidate in candidates
        if candidate.photo in {pair.rgb for pair in pairs}
    }
    rest = [
        candidate._replace(key=PurePosixPath(candidate.key).name)
        for candidate in candidates
        if candidate.photo not in done
        and (candidate.role == "thermal" or not marks or candidate.mark in marks)
    ]
    more, _ = _by_keys(_unique(rest), tolerance_s)
    if not pairs and not more:
        return None
    pairs = tuple(sorted([*pairs, *more], key=lambda pair: natural(str(pair.thermal.origin))))
    return Match(
        pairs,
        "A pair has the same name in the folders of the two cameras.",
        "of its name",
        reasons,
    )


def _unique(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Those whose key no other photo of the same camera has."""
    counts = Counter((candidate.role == "thermal", candidate.key) for candidate in candidates)
    return [
        candidate
        for candidate in candidates
        if counts[candidate.role == "thermal", candidate.key] == 1
    ]


def _by_keys(
    candidates: Sequence[Candidate], tolerance_s: float
) -> tuple[tuple[Pair, ...], dict[Photo, str]]:
    """Photos of equal keys; where the names hold times, they are compared, too."""
    thermal = _grouped(candidate for candidate in candidates if candidate.role == "thermal")
    others = _grouped(candidate for candidate in candidates if candidate.role != "thermal")
    mark = _best_mark(others, thermal.keys())
    pairs: list[Pair] = []
    reasons: dict[Photo, str] = {}
    for key in thermal.keys() & others.keys():
        rgb = [candidate for candidate in others[key] if candidate.mark == mark]
        found = _within_key(rgb, thermal[key], tolerance_s)
        pairs += found
        reasons |= _instead(thermal[key], [pair.thermal for pair in found])
        reasons |= _instead(others[key], [pair.rgb for pair in found])
    return tuple(sorted(pairs, key=lambda pair: natural(str(pair.thermal.origin)))), reasons


def _grouped(candidates: Iterable[Candidate]) -> dict[str, list[Candidate]]:
    groups: dict[str, list[Candidate]] = {}
    for candidate in candidates:
        groups.setdefault(candidate.key, []).append(candidate)
    return groups


def _best_mark(rgb: Mapping[str, Sequence[Candidate]], keys: Collection[str]) -> str:
    """The mark of the RGB photos to be used, for one camera has one lens: the first of those that
    nearly all have."""
    counts = Counter(
        mark for key in rgb if key in keys for mark in {candidate.mark for candidate in rgb[key]}
    )
    order = {mark: index for index, mark in enumerate(RGB_MARKS)}
    enough = NEARLY * max(counts.values(), default=0)
    frequent = sorted(mark for mark in counts if counts[mark] >= enough)
    return min(frequent, key=lambda mark: order.get(mark, len(order)), default="")


def _within_key(
    rgb: Sequence[Candidate], thermal: Sequence[Candidate], tolerance_s: float
) -> list[Pair]:
    """Pairs among photos of one name: the best two, or those whose names hold near times."""
    if any(candidate.moment is None for candidate in [*rgb, *thermal]):
        return [Pair(rgb[0].photo, _best(thermal).photo)] if rgb else []
    first = [group[0] for group in _by_moment(rgb)]
    second = [_best(group) for group in _by_moment(thermal)]
    # The cameras of a drone may write their times a second apart.
    pairs = _matched(first, second, lambda candidate: candidate.moment, 0.0, max(tolerance_s, 1.0))
    return [Pair(one.photo, other.photo) for one, other in pairs]


def _by_moment(candidates: Sequence[Candidate]) -> list[list[Candidate]]:
    moments = {
        candidate.moment: [other for other in candidates if other.moment == candidate.moment]
        for candidate in candidates
    }
    return [*moments.values()]


def _best(candidates: Sequence[Candidate]) -> Candidate:
    """Of several files of one candidate the one with the most to read from; the first of equals."""
    return min(candidates, key=lambda candidate: PREFERENCE.index(candidate.photo.kind))


def _instead(candidates: Sequence[Candidate], used: Sequence[Photo | None]) -> dict[Photo, str]:
    """The reason for files of a candidate that another file of it made superfluous."""
    if len(used) != 1 or used[0] is None:
        return {}
    return {
        candidate.photo: f"{printable(used[0].path.name)} is used instead"
        for candidate in candidates
        if candidate.photo is not used[0]
    }


def by_numbers(photos: Sequence[Photo]) -> Match | None:
    """FLIR's ``IR_0001`` and ``DC_0002``: the photo in visible light is the next file, or the one
    before."""
    candidates = [candidate_by_name(photo) for photo in photos]
    thermal = _grouped(candidate for candidate in candidates if candidate.role == "thermal")
    rgb = _grouped(candidate for candidate in candidates if candidate.role != "thermal")
    best: list[Pair] = []
    word = "next"
    for step, name in ((1, "next"), (-1, "previous")):
        pairs = [
            Pair(rgb[other][0].photo, _best(group).photo)
            for key, group in thermal.items()
            if (other := _neighbour(key, step)) in rgb
            and _near(rgb[other][0].photo, _best(group).photo)
        ]
        if len(pairs) > len(best):
            best, word = pairs, name
    if not best:
        return None
    best.sort(key=lambda pair: natural(str(pair.thermal.origin)))
    rule = f"The RGB photo of each thermal photo is the file with the {word} number."
    return Match(tuple(best), rule, f"with the {word} number")


def _neighbour(key: str, step: int) -> str:
    """The key with the number at its end changed by ``step``, as wide as before; empty if there is
    none."""
    found = re.fullmatch(r"(.*?)([0-9]+)", key, re.DOTALL)
    number = -1 if found is None else int(found[2]) + step
    return "" if found is None or number < 0 else f"{found[1]}{number:0{len(found[2])}d}"


def _near(first: Photo, second: Photo) -> bool:
    """Whether the times, where both are known, allow the two to belong together."""
    if first.exif.taken is None or second.exif.taken is None:
        return True
    return abs((first.exif.taken - second.exif.taken).total_seconds()) <= _NEIGHBOUR_S


def by_embedded(photos: Sequence[Photo]) -> Match | None:
    """The RGB photo embedded in the thermal photo's file."""
    pairs = tuple(Pair(None, photo, embedded=True) for photo in photos if photo.embedded)
    if not pairs:
        return None
    used = "the RGB photos embedded in the thermal photos are used"
    others = [photo for photo in photos if not photo.embedded]
    reasons = {photo: "holds no RGB photo" if photo.is_thermal else used for photo in others}
    return Match(pairs, "The RGB photo embedded in each thermal photo is used.", reasons=reasons)


def by_time(photos: Sequence[Photo], root_name: str, tolerance_s: float) -> Match | None:
    """The nearest in time by EXIF, after the clocks are compared."""
    rgb, thermal = (_timed(group) for group in roles(photos, root_name))
    if not rgb or not thermal:
        return None
    start = min(_taken(photo) for photo in [*rgb, *thermal])
    rgb_s, thermal_s = (
        [(_taken(photo) - start).total_seconds() for photo in group] for group in (rgb, thermal)
    )
    offset = clock_offset(rgb_s, thermal_s, tolerance_s)
    matched = _matched(rgb, thermal, _taken, offset.seconds, tolerance_s)
    if not matched:
        return None
    matched.sort(key=lambda pair: natural(str(pair[1].origin)))
    pairs = tuple(Pair(*pair) for pair in matched)
    unknown = {
        photo: "does not say when it was taken" for photo in photos if photo.exif.taken is None
    }
    rule = f"The photos of a pair were taken within {tolerance_s:g} s."
    if offset.seconds:
        rule = f"{rule[:-1]}, after aligning the clocks: {_ahead(offset.seconds)}."
    return Match(pairs, rule, f"within {tolerance_s:g} s", unknown, _doubts(offset))


def _timed(photos: Sequence[Photo]) -> list[Photo]:
    known = [photo for photo in photos if photo.exif.taken is not None]
    return sorted(known, key=lambda photo: (_taken(photo), natural(str(photo.origin))))


def _taken(photo: Photo) -> datetime:
    if photo.exif.taken is None:
        raise ValueError("the time is not known")
    return photo.exif.taken


def _matched(
    rgb: Sequence, thermal: Sequence, moment_of: Callable, offset_s: float, tolerance_s: float
) -> list[tuple]:
    """One-to-one pairs by time, where the RGB camera's clock is ahead by ``offset_s`` seconds."""
    if not rgb or not thermal:
        return []
    rgb, thermal = sorted(rgb, key=moment_of), sorted(thermal, key=moment_of)
    start, offset = moment_of(thermal[0]), timedelta(seconds=offset_s)
    rgb_s = [(moment_of(one) - offset - start).total_seconds() for one in rgb]
    thermal_s = [(moment_of(one) - start).total_seconds() for one in thermal]
    return [(rgb[i], thermal[j]) for i, j in match_times(rgb_s, thermal_s, tolerance_s)]


def _ahead(offset_s: float) -> str:
    side = "ahead of" if offset_s > 0 else "behind"
    return f"the RGB camera's is {abs(offset_s):.1f} s {side} the thermal camera's"


def _doubts(offset: ClockOffset) -> tuple[str, ...]:
    if offset.rival_s is None:
        return ()
    return (
        f"The clock offset may also be {offset.rival_s:.1f} s instead of {offset.seconds:.1f} s: "
        f"check the first pairs, and give a table of pairs if they are wrong.",
    )
