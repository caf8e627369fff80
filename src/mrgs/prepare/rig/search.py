"""A first guess of the thermal camera: its focal length and direction, from all pairs together.

The two cameras are close to each other, so that far enough away one image is the other, scaled,
shifted and perhaps rotated a little, or by quarter turns. For each scale and rotation, the
structure of the photo is correlated with that of the thermal image over all shifts, and the
correlations are averaged over the pairs, because a single pair may be ambiguous.

What all images of a camera have in common (shading, a sensor's pattern, tripods that always stand
at the bottom) correlates between any two of them, at a scale and shift of its own. So the mean over
all images is first taken from each; only where they are all alike does it have to stay.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Float32
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter

from mrgs.data.undistort import sampled
from mrgs.prepare.contract import Progress
from mrgs.prepare.rig.images import ReducedPair, structure
from mrgs.scene.camera import focal_length

CLEAR = 1.3
LEAST_CORRELATION = 0.35
"""The best first guess must beat every clearly different one by that factor, and reach this over
the root of the number of pairs. Pairs that belong together reached 1.5 and 0.7 at the least; pairs
that do not, never both."""

WIDTHS_PX = (96, 160)
"""Widths of the thermal images; the larger where nothing stands out. It takes more than twice as
long, and distinguished eight faint pairs of a room from exchanged ones, unlike the smaller."""

_BLUR_WIDTHS = 1 / 64
_SCALE_STEP = 1.07
_NARROWEST_DEG, _WIDEST_DEG = 15.0, 100.0
_FINE_STEPS = (0.95, 0.975, 1.0, 1.025, 1.05)
_TURNS_DEG = (-6.0, -3.0, 0.0, 3.0, 6.0)
_QUARTERS_DEG = (90.0, -90.0, 180.0)
_LEAST_OVERLAP = 0.35
_KNOWN_WITHIN = 1.1
_NEAR_SCALE = 1.25
_NEAR_SHIFT = 0.06
_FARTHEST_SHIFT = 0.4


Structures: TypeAlias = Float32[np.ndarray, "pairs c h w"]


@dataclass(frozen=True)
class Guess:
    """A thermal camera at the position of the photos' camera.

    Attributes:
        score: mean correlation over the pairs, at most 1.
        focal_widths: focal length in widths of the thermal image.
        turn_deg: rotation about the optical axis that aligns the photo with the thermal image,
            anticlockwise.
        shift_widths: where the photo's principal point appears, from the thermal image's centre,
            right and down, in widths of the thermal image.
    """

    score: float
    focal_widths: float
    turn_deg: float
    shift_widths: tuple[float, float]


@dataclass(frozen=True)
class Found:
    """The best guess, the best score among clearly different ones (the level of chance in these
    images), and the number of pairs."""

    best: Guess
    chance: float
    pairs: int

    @property
    def stands_out(self) -> bool:
        """Whether the guess is unlikely to be chance."""
        least = LEAST_CORRELATION / math.sqrt(self.pairs)
        return self.best.score >= max(CLEAR * self.chance, least)


def first_guess(
    pairs: Sequence[ReducedPair], field_of_view_deg: float | None, report: Progress | None = None
) -> Found:
    """Search fields of view from 15° to 100° (or around a given one), rotations up to 6°, and
    shifts up to 0.4 widths; without what all images of a camera have in common, and if nothing
    stands out, with it; then at the larger width. If still nothing does, the same about each
    quarter turn: one camera may be mounted on its side, or only one may note how it was held. The
    field of view is horizontal, of the thermal camera; ``report`` counts the cameras that were
    tried, of all that are planned so far."""
    focals = _focals(field_of_view_deg)
    each = len(focals) + len(_FINE_STEPS) * len(_TURNS_DEG)
    counts = itertools.count()

    def about(about_deg: float, form: tuple[Structures, bool], rounds: int) -> Found:
        def correlated(focal: float, turn_deg: float) -> Found:
            if report is not None:
                report("searching the thermal camera", next(counts), rounds * each)
            return _correlated(pairs, *form, focal, turn_deg)

        return _best_about(about_deg, focals, correlated)

    upright = []
    for rounds, form in enumerate(_forms(pairs), start=1):
        found = about(0.0, form, rounds)
        if found.stands_out:
            return found
        upright.append((form, found))
    rounds += 2 * len(_QUARTERS_DEG)
    best = []
    for form, first in upright[:2]:
        turned = [first, *(about(turn_deg, form, rounds) for turn_deg in _QUARTERS_DEG)]
        turned.sort(key=lambda one: -one.best.score)
        chance = max(turned[0].chance, turned[1].best.score)
        best.append(Found(turned[0].best, chance, len(pairs)))
    return max(best, key=lambda one: one.best.score / max(one.chance, 1e-9))


def _forms(pairs: Sequence[ReducedPair]) -> Iterator[tuple[Structures, bool]]:
    """The structure of thermal images at each width, without (True) and with what all share."""
    rows, columns = pairs[0].thermal.values.shape
    for width in WIDTHS_PX:
        size, blur_px = (width, max(1, round(rows * width / columns))), _BLUR_WIDTHS * width
        planes = [pair.thermal.resized(*size) for pair in pairs]
        thermal = np.stack([structure(plane.values, blur_px, plane.valid) for plane in planes])
        yield thermal - thermal.mean(axis=0), True
        yield thermal, False


def _best_about(
    about_deg: float, focals: Sequence[float], correlated: Callable[[float, float], Found]
) -> Found:
    """The best guess near a rotation; ``correlated`` finds it for a focal length and a rotation."""
    coarse = [correlated(focal, about_deg) for focal in focals]
    best, second = max(coarse, key=lambda found: found.best.score), 0.0
    fine = [
        correlated(best.best.focal_widths * step, about_deg + turn_deg)
        for step in _FINE_STEPS
        for turn_deg in _TURNS_DEG
    ]
    best = max([best, *fine], key=lambda found: found.best.score)
    for found in coarse:
        near = abs(np.log(found.best.focal_widths / best.best.focal_widths)) < np.log(_NEAR_SCALE)
        second = max(second, found.chance if near else found.best.score)
    return Found(best.best, second, best.pairs)


def _focals(field_of_view_deg: float | None) -> list[float]:
    """Focal lengths to try, in image widths."""
    low, high = (focal_length(1.0, math.radians(deg)) for deg in (_WIDEST_DEG, _NARROWEST_DEG))
    if field_of_view_deg is not None:
        known = focal_length(1.0, math.radians(field_of_view_deg))
        low, high = known / _KNOWN_WITHIN, known * _KNOWN_WITHIN
    steps = round(np.log(high / low) / np.log(_SCALE_STEP)) + 1
    return [float(value) for value in np.geomspace(low, high, steps)]


def _correlated(
    pairs: Sequence[ReducedPair],
    thermal: Structures,
    own: bool,
    focal_widths: float,
    turn_deg: float,
) -> Found:
    """The best shift for a focal length and a rotation, and the best that is far from it; ``own``
    takes from each photo what all have in common, as was done with the thermal images."""
    height, width = thermal[0].shape[1:]
    scales = [focal_widths * width / pair.camera.K[0, 0].item() for pair in pairs]
    sides = [
        2 * round(scale * max(p.camera.width, p.camera.height) / 2)
        for p, scale in zip(pairs, scales, strict=True)
    ]
    side = max(sides)
    size = (next_fast_len(side + height), next_fast_len(side + width))
    total = np.zeros(size, dtype=np.float32)
    blur_px = _BLUR_WIDTHS * width
    photos = [_photo(p, s, turn_deg, side, blur_px) for p, s in zip(pairs, scales, strict=True)]
    common = sum(photo for photo, _ in photos) / len(photos) if own else np.float32(0)
    for channels, (photo, seen) in zip(thermal, photos, strict=True):
        total += _correlation(channels, photo - common * seen, seen, size) / len(pairs)
    right, down = (_shifts(n, t, side) / width for n, t in ((size[1], width), (size[0], height)))
    total[np.abs(down) > _FARTHEST_SHIFT] = 0.0
    total[:, np.abs(right) > _FARTHEST_SHIFT] = 0.0
    row, column = np.unravel_index(total.argmax(), size)
    guess = Guess(
        float(total[row, column]), focal_widths, turn_deg, (float(right[column]), float(down[row]))
    )
    near = (np.abs(down - down[row]) < _NEAR_SHIFT)[:, None] & (
        np.abs(right - right[column]) < _NEAR_SHIFT
    )
    return Found(guess, float(np.where(near, 0.0, total).max()), len(pairs))


def _shifts(count: int, thermal: int, side: int) -> Float[np.ndarray, " n"]:
    """The photo's shift from the thermal image, px, for each place of a cyclic correlation."""
    places = np.arange(count)
    places = np.where(places < count - thermal, places, places - count)
    return side / 2 - places - thermal / 2


def _photo(
    pair: ReducedPair, scale: float, turn_deg: float, side: int, blur_px: float
) -> tuple[Float32[np.ndarray, "c s s"], Float32[np.ndarray, "s s"]]:
    """The photo's structure, scaled and rotated about its principal point, in a square."""
    values = pair.photo.values
    if scale < 1:
        values = gaussian_filter(values, 0.5 * np.sqrt(1 / scale**2 - 1))
    x, y = np.meshgrid(*2 * [np.arange(side) + 0.5 - side / 2])
    cos, sin = np.cos(np.radians(turn_deg)) / scale, np.sin(np.radians(turn_deg)) / scale
    u = cos * x - sin * y + pair.camera.K[0, 2].item()
    v = sin * x + cos * y + pair.camera.K[1, 2].item()
    seen = (u > 0) & (u < pair.camera.width) & (v > 0) & (v < pair.camera.height)
    if pair.photo.valid is not None:
        seen &= sampled(pair.photo.valid.astype(np.float32), u, v) > 0.5
    return structure(sampled(values, u, v), blur_px, seen), seen.astype(np.float32)


def _correlation(
    thermal: Float32[np.ndarray, "c h w"],
    photo: Float32[np.ndarray, "c s s"],
    seen: Float32[np.ndarray, "s s"],
    size: tuple[int, int],
) -> Float32[np.ndarray, "rows columns"]:
    """Normalised correlation of the thermal image with the overlapping part of the photo, for each
    (cyclic) shift; 0 where the overlap is too small, and lowered where it is not complete: smaller
    parts correlate better by chance."""
    ones = np.ones(thermal.shape[1:], dtype=np.float32)
    window, area = np.conj(rfft2(ones, size)), rfft2(seen, size)
    product = irfft2((np.conj(rfft2(thermal, size)) * rfft2(photo, size)).sum(axis=0), size)
    of_thermal = irfft2(np.conj(rfft2((thermal**2).sum(axis=0), size)) * area, size)
    of_photo = irfft2(window * rfft2((photo**2).sum(axis=0), size), size)
    overlap = irfft2(window * area, size)
    enough = overlap > _LEAST_OVERLAP * min(ones.size, float(seen.sum()))
    energy = np.sqrt(np.maximum(of_thermal * of_photo, 1e-6))
    found = product / energy * np.sqrt(overlap.clip(min=0) / ones.size)
    return np.where(enough, found, 0.0).astype(np.float32)
