"""Rules that pair photos. Each returns a match; ``find`` chooses among them.

A pair has a photo of the reference modality (thermal) and its partner (RGB).
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import PurePosixPath
from statistics import median
from typing import NamedTuple

from mrgs.data.files import composed
from mrgs.errors import printable
from mrgs.prepare.pairs.clocks import clock_offset, match_times
from mrgs.prepare.pairs.photo import (
    PARTNER,
    PARTNER_MARKS,
    REFERENCE,
    Candidate,
    Photo,
    candidate_by_folder,
    candidate_by_name,
    natural,
)
from mrgs.scene import Modality

_NEIGHBOUR_S = 10.0
"""Photos with neighbouring numbers taken more seconds apart do not belong together."""

NEARLY = 0.9
"""A better camera is taken even if another has a few photos more: down to this share."""


class Pair(NamedTuple):
    """A photo of the reference modality, and its partner from the same moment: a file, embedded in
    the reference, or missing."""

    reference: Photo
    partner: Photo | None = None
    embedded: bool = False

    @property
    def photos(self) -> dict[Modality, Photo]:
        """The files by modality, the partner first."""
        partner = {} if self.partner is None else {PARTNER: self.partner}
        return partner | {REFERENCE: self.reference}


@dataclass(frozen=True)
class Match:
    """Pairs found by a rule.

    Attributes:
        pairs: in natural order of the reference photos.
        rule: one sentence.
        without: what a photo without partner lacks; ends the reason "has no RGB photo ...".
        reasons: why a photo is not used, where that needs another sentence.
    """

    pairs: tuple[Pair, ...]
    rule: str
    without: str = ""
    reasons: Mapping[Photo, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


def in_order(pairs: Iterable[Pair]) -> tuple[Pair, ...]:
    """The pairs in natural order of the reference photos."""
    return tuple(sorted(pairs, key=lambda pair: natural(str(pair.reference.origin))))


def by_names(photos: Sequence[Photo], tolerance_s: float) -> Match | None:
    """``DJI_0001_T`` and ``DJI_0001_W``, ``a_thermal`` and ``a_rgb``, and so on, in one folder."""
    pairs, reasons = _by_keys([candidate_by_name(photo) for photo in photos], tolerance_s)
    if not pairs:
        return None
    names = [printable(photo.path.name) for photo in pairs[0].photos.values()]
    rule = f"The names of a pair differ only in the camera suffix, such as {' and '.join(names)}."
    return Match(pairs, rule, "of its name", reasons)


def by_folders(photos: Sequence[Photo], tolerance_s: float) -> Match | None:
    """Equal names in folders such as ``rgb`` and ``thermal``, in equal folders around these, or
    else unique; names that are equal to the letter come before names with a camera suffix. What
    else a folder is called, as in ``roof_rgb``, must be equal, too, unless more pairs are found
    without that."""
    found = [_by_folders(photos, tolerance_s, with_rest) for with_rest in (True, False)]
    return max(filter(None, found), key=lambda match: len(match.pairs), default=None)


def _by_folders(photos: Sequence[Photo], tolerance_s: float, with_rest: bool) -> Match | None:
    candidates = [candidate_by_folder(photo, with_rest) for photo in photos]
    pairs: list[Pair] = []
    reasons: dict[Photo, str] = {}

    def add(found: tuple[tuple[Pair, ...], dict[Photo, str]]) -> list[Candidate]:
        """Add what was found; returns the candidates that are left."""
        pairs.extend(found[0])
        reasons.update(found[1])
        done = {*reasons, *(photo for pair in pairs for photo in pair.photos.values())}
        return [candidate for candidate in candidates if candidate.photo not in done]

    whole = []  # with the whole stem in the key, and no suffix
    for each in candidates:
        folder, stem = each.key.rpartition("/")[0], each.photo.origin.name
        key = f"{folder}/{composed(stem.casefold())}"
        whole.append(each._replace(key=key, mark="", moment=None))
    left = add(_by_keys(whole, tolerance_s))
    left = add(_by_keys(left, tolerance_s))
    partners = {pair.partner for pair in pairs}
    marks = {candidate.mark for candidate in candidates if candidate.photo in partners}
    rest = [
        candidate._replace(key=PurePosixPath(candidate.key).name)
        for candidate in left
        if candidate.is_reference or not marks or candidate.mark in marks
    ]
    counts = Counter((candidate.is_reference, candidate.key) for candidate in rest)
    unique = [each for each in rest if counts[each.is_reference, each.key] == 1]
    pairs += _by_keys(unique, tolerance_s)[0]
    rule = "A pair has the same name in the folders of the two cameras."
    return Match(in_order(pairs), rule, "of its name", reasons) if pairs else None


def _by_keys(
    candidates: Sequence[Candidate], tolerance_s: float
) -> tuple[tuple[Pair, ...], dict[Photo, str]]:
    """Photos of equal keys; where the names hold times, they are compared, too."""
    references, partners = _grouped(candidates)
    mark = _best_mark(partners, references.keys())
    pairs: list[Pair] = []
    reasons: dict[Photo, str] = {}
    for key in references.keys() & partners.keys():
        marked = [candidate for candidate in partners[key] if candidate.mark == mark]
        found = _within_key(references[key], marked, tolerance_s)
        pairs += found
        reasons |= _instead(references[key], [pair.reference for pair in found])
        reasons |= _instead(partners[key], [pair.partner for pair in found])
    return in_order(pairs), reasons


Groups = dict[str, list[Candidate]]


def _grouped(candidates: Iterable[Candidate]) -> tuple[Groups, Groups]:
    """The reference photos and the others, by their keys."""
    groups: tuple[Groups, Groups] = ({}, {})
    for candidate in candidates:
        own = groups[0 if candidate.is_reference else 1]
        own.setdefault(candidate.key, []).append(candidate)
    return groups


def _best_mark(partners: Groups, keys: Collection[str]) -> str:
    """The mark of the partners to be used, because one camera has one lens: the first of those
    that nearly all have."""
    counts = Counter(
        mark
        for key, group in partners.items()
        if key in keys
        for mark in {candidate.mark for candidate in group}
    )
    order = {mark: index for index, mark in enumerate(PARTNER_MARKS)}
    enough = NEARLY * max(counts.values(), default=0)
    frequent = sorted(mark for mark in counts if counts[mark] >= enough)
    return min(frequent, key=lambda mark: order.get(mark, len(order)), default="")


def _within_key(
    references: Sequence[Candidate], partners: Sequence[Candidate], tolerance_s: float
) -> list[Pair]:
    """Pairs among photos of one name: the best two, or those whose names hold close times."""
    if any(candidate.moment is None for candidate in [*references, *partners]):
        return [Pair(_best(references).photo, partners[0].photo)] if partners else []
    moments = dict.fromkeys(candidate.moment for candidate in references)
    first = [_best([each for each in references if each.moment == moment]) for moment in moments]
    second = [*{candidate.moment: candidate for candidate in reversed(partners)}.values()]
    # The cameras of a drone may write their times a second apart.
    pairs = _matched(first, second, lambda candidate: candidate.moment, 0.0, max(tolerance_s, 1.0))
    return [Pair(one.photo, other.photo) for one, other in pairs]


def _best(candidates: Sequence[Candidate]) -> Candidate:
    """The best of several files of one photo; the first of equals."""
    return min(candidates, key=lambda candidate: candidate.photo.preference)


def _instead(candidates: Sequence[Candidate], used: Sequence[Photo | None]) -> dict[Photo, str]:
    """The reason for files that another file of the same name and camera replaces."""
    if len(used) != 1 or used[0] is None:
        return {}
    return {
        candidate.photo: f"{printable(used[0].path.name)} is used instead"
        for candidate in candidates
        if candidate.photo is not used[0]
    }


def by_numbers(photos: Sequence[Photo]) -> Match | None:
    """FLIR's ``IR_0001`` and ``DC_0002``: the RGB photo is the next file, or the one before; of
    two ways to pair nearly all, as where the first or the last photo is missing, the one whose
    photos are closer in time."""
    references, partners = _grouped(candidate_by_name(photo) for photo in photos)
    found = {
        word: [
            Pair(_best(group).photo, partners[other][0].photo)
            for key, group in references.items()
            if (other := _neighbour(key, step)) in partners
            and _gap_s(_best(group).photo, partners[other][0].photo) <= _NEIGHBOUR_S
        ]
        for step, word in ((1, "next"), (-1, "previous"))
    }
    most = max(map(len, found.values()))
    if not most:
        return None
    likely = {
        word: median(_gap_s(*pair.photos.values()) for pair in pairs)
        for word, pairs in found.items()
        if pairs and len(pairs) >= most - 1
    }
    word = min(likely, key=lambda word: (likely[word], -len(found[word])))
    rule = (
        f"The {PARTNER.title} photo of each {REFERENCE.title} photo is the file with the {word} "
        f"number."
    )
    doubts = []  # thermal first is the usual order; where no times speak against it
    if word == "previous" and likely[word] >= likely.get("next", math.inf):
        doubts.append(
            "Of photos in turns the first or the last may be missing: check that the two photos of "
            "a pair show the same."
        )
    return Match(in_order(found[word]), rule, f"with the {word} number", warnings=tuple(doubts))


def _neighbour(key: str, step: int) -> str:
    """The key with the number at its end changed by ``step``, as wide as before; empty for none."""
    found = re.fullmatch(r"(.*?)([0-9]+)", key, re.DOTALL)
    number = -1 if found is None else int(found[2]) + step
    return "" if found is None or number < 0 else f"{found[1]}{number:0{len(found[2])}d}"


def _gap_s(first: Photo, second: Photo) -> float:
    """Seconds between two photos; 0 where a time is not known."""
    if first.exif.taken is None or second.exif.taken is None:
        return 0.0
    return abs((first.exif.taken - second.exif.taken).total_seconds())


def by_embedded(photos: Sequence[Photo]) -> Match | None:
    """The partner embedded in the file of each reference photo."""
    pairs = tuple(Pair(photo, embedded=True) for photo in photos if photo.embedded)
    if not pairs:
        return None
    used = f"the {PARTNER.title} photos embedded in the {REFERENCE.title} photos are used"
    lacking = f"holds no {PARTNER.title} photo"
    others = [photo for photo in photos if not photo.embedded]
    reasons = {photo: lacking if photo.is_thermal else used for photo in others}
    rule = f"The {PARTNER.title} photo embedded in each {REFERENCE.title} photo is used."
    return Match(pairs, rule, reasons=reasons)


def by_time(photos: Sequence[Photo], tolerance_s: float) -> Match | None:
    """The nearest in time by EXIF, after the clocks are compared."""
    timed = [photo for photo in photos if photo.exif.taken is not None]
    in_zones = all(photo.exif.zone_s is not None for photo in timed)

    def moment(photo: Photo) -> datetime:
        """When a photo was taken, in UTC if all photos know their zones."""
        assert photo.exif.taken is not None
        zone_s = photo.exif.zone_s if in_zones else None
        return photo.exif.taken - timedelta(seconds=zone_s or 0.0)

    references, partners = (
        sorted(
            (photo for photo in timed if photo.is_reference == wanted),
            key=lambda photo: (moment(photo), natural(str(photo.origin))),
        )
        for wanted in (True, False)
    )
    if not references or not partners:
        return None
    start = min(moment(photo) for photo in [*references, *partners])
    references_s, partners_s = (
        [(moment(photo) - start).total_seconds() for photo in group]
        for group in (references, partners)
    )
    offset = clock_offset(partners_s, references_s, tolerance_s)
    matched = _matched(references, partners, moment, offset.seconds, tolerance_s)
    if not matched:
        return None
    unknown = {
        photo: "does not say when it was taken" for photo in photos if photo.exif.taken is None
    }
    rule = f"The photos of a pair were taken within {tolerance_s:g} s."
    if offset.seconds:
        side = "ahead of" if offset.seconds > 0 else "behind"
        rule = (
            f"{rule[:-1]}, after aligning the clocks: the {PARTNER.title} camera's is "
            f"{abs(offset.seconds):.1f} s {side} the {REFERENCE.title} camera's."
        )
    doubt: tuple[str, ...] = ()
    if rival := offset.rival:
        also = (
            f"The clock offset may also be {rival.seconds:.1f} s instead of {offset.seconds:.1f} s"
        )
        if rival.pairs < offset.pairs:
            rule = f"{rule} {also}, but fewer photos would find a partner."
        else:
            remedy = "check the first pairs, and give a table of pairs if they are wrong."
            doubt = (f"{also}: {remedy}",)
    pairs = in_order(Pair(*pair) for pair in matched)
    return Match(pairs, rule, f"within {tolerance_s:g} s", unknown, doubt)


def _matched(
    references: Sequence,
    partners: Sequence,
    moment_of: Callable,
    offset_s: float,
    tolerance_s: float,
) -> list[tuple]:
    """One-to-one pairs by time, where the partners' clock is ahead by ``offset_s`` seconds."""
    if not references or not partners:
        return []
    references, partners = (sorted(group, key=moment_of) for group in (references, partners))
    start, offset = moment_of(references[0]), timedelta(seconds=offset_s)
    references_s = [(moment_of(one) - start).total_seconds() for one in references]
    partners_s = [(moment_of(one) - offset - start).total_seconds() for one in partners]
    matched = match_times(partners_s, references_s, tolerance_s)
    return [(references[j], partners[i]) for i, j in matched]
