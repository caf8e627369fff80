"""Rules that pair photos. Each returns a match; ``find`` chooses among them.

A pair has a photo of the reference modality (thermal) and its partner (RGB). Where times decide,
the offset between the clocks of the two cameras is found first.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import PurePosixPath
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.optimize import linear_sum_assignment

from mrgs.data.files import composed
from mrgs.errors import printable
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
    else unique; names that are equal to the letter come before names with a camera suffix."""
    candidates = [candidate_by_folder(photo) for photo in photos]
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
    """FLIR's ``IR_0001`` and ``DC_0002``: the photo in visible light is the next file, or the one
    before."""
    references, partners = _grouped(candidate_by_name(photo) for photo in photos)
    best: list[Pair] = []
    word = "next"
    for step, name in ((1, "next"), (-1, "previous")):
        pairs = [
            Pair(_best(group).photo, partners[other][0].photo)
            for key, group in references.items()
            if (other := _neighbour(key, step)) in partners
            and _near(_best(group).photo, partners[other][0].photo)
        ]
        if len(pairs) > len(best):
            best, word = pairs, name
    if not best:
        return None
    rule = (
        f"The {PARTNER.title} photo of each {REFERENCE.title} photo is the file with the {word} "
        f"number."
    )
    return Match(in_order(best), rule, f"with the {word} number")


def _neighbour(key: str, step: int) -> str:
    """The key with the number at its end changed by ``step``, as wide as before; empty for none."""
    found = re.fullmatch(r"(.*?)([0-9]+)", key, re.DOTALL)
    number = -1 if found is None else int(found[2]) + step
    return "" if found is None or number < 0 else f"{found[1]}{number:0{len(found[2])}d}"


def _near(first: Photo, second: Photo) -> bool:
    """Whether the times, where both are known, allow the two to belong together."""
    if first.exif.taken is None or second.exif.taken is None:
        return True
    return abs((first.exif.taken - second.exif.taken).total_seconds()) <= _NEIGHBOUR_S


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


_AS_GOOD = 0.9
"""An offset with this share of another one's pairs is as good."""

_TRIED = 24
"""Number of the most frequent differences of two times that are tried as offsets."""

_LOOKED_AT = 50_000
"""Number of differences, the most frequent first, that are searched."""

_FEWEST = 3
"""Fewer pairs than this prove no offset."""

_CLOCK_S = 0.2
"""What clocks of whole seconds let the spread of what pairs are apart vary by, seconds."""

_RANK_S = 1e-5
"""Photos of the same second are ordered as if they were this far apart, seconds."""


@dataclass(frozen=True)
class ClockOffset:
    """Offset between the clocks of two cameras: time on the first minus time on the second, at the
    same moment; the number of pairs with this offset; and another one with nearly as many, None if
    there is none."""

    seconds: float
    pairs: int
    rival: ClockOffset | None = None


def match_times(
    first_s: Sequence[float], second_s: Sequence[float], tolerance_s: float
) -> list[tuple[int, int]]:
    """Pairs of indices of photos at most ``tolerance_s`` seconds apart, by ascending times on one
    clock: as many as possible, and then the nearest."""
    first, second = np.asarray(first_s, np.float64), np.asarray(second_s, np.float64)
    times = np.sort(np.concatenate([first, second]))
    starts = times[1:][np.diff(times) > tolerance_s]  # no pair bridges these gaps
    of_first, of_second = (np.searchsorted(starts, each, "right") for each in (first, second))
    pairs: list[tuple[int, int]] = []
    for cluster in np.intersect1d(of_first, of_second):
        rows, columns = np.flatnonzero(of_first == cluster), np.flatnonzero(of_second == cluster)
        apart = first[rows, None] - second[columns]
        near = np.abs(apart) <= tolerance_s
        # Squares keep the order where times are equal.
        order = np.arange(len(rows))[:, None] - np.arange(len(columns))
        cost = (apart + _RANK_S * order) ** 2
        forbidden = (1 + cost[near].max(initial=0.0)) * (1 + min(cost.shape))
        chosen = zip(*linear_sum_assignment(np.where(near, cost, forbidden)), strict=True)
        pairs += [(int(rows[i]), int(columns[j])) for i, j in chosen if near[i, j]]
    return sorted(pairs, key=lambda pair: pair[1])


def clock_offset(
    first_s: Sequence[float], second_s: Sequence[float], tolerance_s: float
) -> ClockOffset:
    """The clock offset with which most photos find a partner within ``tolerance_s`` seconds, by
    ascending times; 0 where that is nearly as good. What the pairs are apart must not vary by much
    more than with another offset, as it does where all are shifted by one photo."""
    first, second = np.asarray(first_s, np.float64), np.asarray(second_s, np.float64)
    smaller = min(len(first), len(second))
    if smaller < _FEWEST:
        return ClockOffset(0.0, len(_apart(first, second, tolerance_s)))
    windows_s = (0.5, max(tolerance_s, 0.5))
    tried = {s for window_s in windows_s for s in _frequent_differences(first, second, window_s)}
    tests = []
    for seconds in (0.0, *sorted(tried - {0.0})):
        apart = _apart(first - seconds, second, tolerance_s)
        spread = float(np.abs(apart - np.median(apart)).mean()) if len(apart) else np.inf
        tests.append((ClockOffset(seconds, len(apart)), spread))
    in_step = tests[0][0]
    most = max(one.pairs for one, _ in tests)
    if most < max(_FEWEST, smaller / 2):
        return in_step
    tests = [(one, spread) for one, spread in tests if one.pairs >= _AS_GOOD * most]
    highest = 2 * min(spread for _, spread in tests) + _CLOCK_S
    tests = [(one, spread) for one, spread in tests if spread <= highest]
    tests.sort(key=lambda each: (each[0] is not in_step, -each[0].pairs, each[1]))
    best = tests[0][0]
    far = [one for one, _ in tests if abs(one.seconds - best.seconds) > windows_s[1]]
    rival = max(far, key=lambda one: one.pairs, default=None)
    if rival is not None and best is in_step and rival.pairs <= best.pairs:
        rival = None  # clocks that may be in step are not doubted for less
    return ClockOffset(best.seconds, best.pairs, rival)


def _frequent_differences(
    first: Float64[np.ndarray, " m"], second: Float64[np.ndarray, " n"], window_s: float
) -> list[float]:
    """Centres of the windows with most of the differences between all times of the two cameras."""
    differences = np.sort((first[:, None] - second).ravel())
    ends = np.searchsorted(differences, differences + window_s, "right")
    counts = ends - np.arange(len(differences))
    centres: list[float] = []
    for start in np.argsort(-counts, kind="stable")[:_LOOKED_AT]:
        centre = float(differences[(start + ends[start]) // 2])  # the median, as they are sorted
        if all(abs(centre - other) > window_s / 2 for other in centres):
            centres.append(centre)
        if len(centres) == _TRIED:
            break
    return centres


def _apart(
    first: Float64[np.ndarray, " m"], second: Float64[np.ndarray, " n"], tolerance_s: float
) -> Float64[np.ndarray, " pairs"]:
    """How far apart the photos of as many pairs as there can be were taken: with sorted times,
    taking the first that fits is best."""
    i = j = 0
    found: list[float] = []
    ours, theirs = first.tolist(), second.tolist()
    while i < len(ours) and j < len(theirs):
        apart = ours[i] - theirs[j]
        if abs(apart) <= tolerance_s:
            i, j = i + 1, j + 1
            found.append(apart)
        elif apart < 0:
            i += 1
        else:
            j += 1
    return np.array(found)
