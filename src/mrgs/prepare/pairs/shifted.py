"""Pairs that the times of their photos contradict."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from mrgs.prepare.pairs.names import printable
from mrgs.prepare.pairs.rules import NEARLY, Pair

_FEWEST_TIMED, _FEWEST_SHIFTED = 5, 2
_NEARER_S = 2.0
"""A pair is doubted if its partner was taken that many seconds nearer to another photo, where at
least so many pairs have times and so many are doubted."""


def shifted(pairs: Sequence[Pair]) -> tuple[str, ...]:
    """A doubt about pairs whose times contradict them: where a photo is missing in a row of equal
    numbers, each later one is paired with its neighbour's partner."""
    timed = [
        (pair, reference, partner)
        for pair in pairs
        if (reference := pair.reference.exif.taken) is not None
        and pair.partner is not None
        and (partner := pair.partner.exif.taken) is not None
    ]
    if len(timed) < _FEWEST_TIMED:
        return ()
    start = timed[0][1]
    references_s = np.array([(taken - start).total_seconds() for _, taken, _ in timed])
    partners_s = np.array([(taken - start).total_seconds() for _, _, taken in timed])
    aligned_s = partners_s - np.median(partners_s - references_s)
    gaps_s = np.abs(aligned_s - references_s)
    wrong = (gaps_s > _nearest(aligned_s, references_s) + _NEARER_S).nonzero()[0]
    if len(wrong) < max(_FEWEST_SHIFTED, (1 - NEARLY) * len(timed)):
        return ()
    names = [printable(photo.path.name) for photo in timed[wrong[0]][0].photos.values()]
    return (
        f"By their times {len(wrong)} of {len(timed)} pairs were not taken together, such as "
        f"{' and '.join(names)}: a photo may be missing in the row. Pair by time, or list the "
        f"pairs in a CSV file.",
    )


def _nearest(
    values: Float64[np.ndarray, " n"], others: Float64[np.ndarray, " m"]
) -> Float64[np.ndarray, " n"]:
    """Distance of each value to the nearest of the others."""
    others = np.sort(others)
    after = np.clip(np.searchsorted(others, values), 1, len(others) - 1)
    return np.minimum(np.abs(values - others[after - 1]), np.abs(values - others[after]))
