"""Rules for a scene's photos, and the statistics that they judge."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32

from mrgs.check.problem import (
    Evidence,
    ImageStatistics,
    Problem,
    Severity,
    cameras_by_modality,
    views_text,
)
from mrgs.data.images import LUMINANCE, NARROW, decode
from mrgs.data.undistort import reduced, sampled
from mrgs.scene import RGB, THERMAL, Camera, Modality, Pixels, PointCloud, PosedImage, Scene
from mrgs.scene.modality import in_order
from mrgs.scene.view import evenly_spaced

FEW_VIEWS = 12
"""Number of views whose photos are inspected before each training."""

WIDTH_PX, FAST_WIDTH_PX = 1600, 600
"""A large photo may be decoded at a fraction of its size that is at least this wide: blur that does
not show there blurs hardly any model. The second before each training."""

_PIXELS = 250_000
"""Maximum number of pixels whose bits and digest are computed, evenly spaced."""

_SMALL_PX = 240

_AT_END = 1e-3
"""A normalised value nearer than this to 0 or 1 (a quarter of an 8-bit step) is at an end."""

_SATURATED = 0.02
"""Share of a set's thermal pixels that gives a warning; a view is named at five times that."""

_OUTSIDE = 0.01
"""Share of a view's thermal pixels that gives a warning."""

_UNIFORM = 0.01
"""An image whose values have a smaller spread (1 % to 99 % quantile) has no content."""

_BLACK = 1 / 255
_WHOLE = 1e-2
_BLURRED = 0.4
"""Share of the set's median sharpness below which an image counts as blurred."""

_FEWEST_TO_COMPARE = 5

_EXPECTED: dict[Modality, tuple[Severity, str]] = {
    THERMAL: ("warning", "temperatures"),
    RGB: ("note", "colours"),
}
"""Severity if no view has an image of a modality, and what the model will then lack."""


def measure_few(scene: Scene) -> dict[Modality, dict[str, ImageStatistics]]:
    """Statistics of the photos of ``FEW_VIEWS`` training views, from as few pixels as suffice.
    SceneError if a photo cannot be read."""
    found: dict[Modality, dict[str, ImageStatistics]] = {each: {} for each in scene.modalities}
    for place in evenly_spaced(len(scene.train), FEW_VIEWS):
        view = scene.train[place]
        for modality, photo in view.images.items():
            if modality == THERMAL or not photo.files:
                pixels = photo.load()
            else:  # not undistorted: that would require reading a large file whole
                pixels = Pixels(decode(photo.files[0], FAST_WIDTH_PX).values)
            found[modality][view.name] = measure(pixels, photo)
    return found


def measure(pixels: Pixels, photo: PosedImage) -> ImageStatistics:
    """Statistics of a photo's pixels."""
    values = pixels.values
    luminance = values @ LUMINANCE if values.shape[-1] == 3 else values.mean(dim=-1)
    known = luminance.flatten() if pixels.valid is None else luminance[pixels.valid]
    low, high = np.quantile(known.numpy(), [0.01, 0.99]) if known.numel() else (0.0, 0.0)
    step = max(1, math.ceil(math.sqrt(luminance.numel() / _PIXELS)))
    some = values[::step, ::step].numpy()
    small, valid = reduced(luminance[..., None], pixels.valid, _SMALL_PX)
    small = small[..., 0] if valid is None else torch.where(valid, small[..., 0], torch.nan)
    return ImageStatistics(
        sharpness(luminance.double().numpy()),
        low_end=(known <= _AT_END).float().mean().item() if known.numel() else 0.0,
        high_end=(known >= 1 - _AT_END).float().mean().item() if known.numel() else 0.0,
        spread=float(high - low),
        brightest=float(values.max()),
        bits=_used_bits(some),
        digest=hashlib.sha256(some.tobytes()).digest(),
        small=small,
        camera=photo.camera.at_most(small.shape[1]),
    )


def sharpness(image: Float[np.ndarray, "h w"]) -> float:
    """Share of an image's contrast in its finest details: 0 for a smooth image, about 1 for a crisp
    one; it hardly depends on the content. The mean squared difference between neighbours over that
    at half the resolution, in the direction where it is smaller: motion blurs in one."""
    height, width = (size // 2 * 2 for size in image.shape)
    fine = image[:height, :width]
    coarse = fine.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
    ratios = []
    for axis in (0, 1):
        below = np.square(np.diff(coarse, axis=axis)).mean() if min(coarse.shape) > 1 else 0.0
        ratios.append(
            np.square(np.diff(fine, axis=axis)).mean() / below - 0.25 if below > 1e-12 else 0.0
        )
    return float(max(min(ratios), 0.0))


def _used_bits(values: Float32[np.ndarray, "h w c"]) -> int | None:
    """Number of bits of the largest value of a 16-bit image; None where the values are not whole
    multiples of 1 / 65535, or all are multiples of 1 / 255."""
    levels = values.astype(np.float64) * 65535
    eight = values.astype(np.float64) * 255
    if np.abs(levels - np.rint(levels)).max() >= _WHOLE or (
        np.abs(eight - np.rint(eight)).max() < _WHOLE
    ):
        return None
    return round(float(levels.max())).bit_length()


def unreadable(evidence: Evidence) -> Iterator[Problem]:
    """Photos that cannot be read."""
    return (Problem("error", message) for message in evidence.unreadable)


def missing(evidence: Evidence) -> Iterator[Problem]:
    """Views that lack an image of a modality, which in a scene made from arrays is meant."""
    views, present = evidence.scene.views, cameras_by_modality(evidence.scene)
    for modality in in_order((*_EXPECTED, *present)):
        title = modality.title
        lacking = [view.name for view in views if modality not in view.images]
        if modality not in present:
            severity, what = _EXPECTED[modality]
            text = f"No view has any {title} image: the model will have no {what}."
            if evidence.scene.path:
                yield Problem(severity, text, "Name them in the file if there are any.")
        elif lacking:
            text = f"There is no {title} image in {views_text(lacking)}."
            yield Problem("warning", text, f"Add the {title} images, unless that is meant.")


def without_temperatures(evidence: Evidence) -> Iterator[Problem]:
    """Thermal images without a temperature scale."""
    if evidence.scene.temperature is None and THERMAL in cameras_by_modality(evidence.scene):
        yield Problem(
            "warning",
            "There is no temperature_bounds.json: thermal values are relative, without °C.",
            "Add it with the temperatures of black and white, absolute_min_temperature and "
            "absolute_max_temperature.",
        )


def sizes(evidence: Evidence) -> Iterator[Problem]:
    """Images of a modality in several sizes: another camera, or some were resized."""
    for modality, cameras in cameras_by_modality(evidence.scene).items():
        found = Counter(f"{camera.width}×{camera.height}" for camera in cameras.values())
        if len(found) > 1:
            counts = ", ".join(f"{count} of {size} px" for size, count in found.items())
            yield Problem(
                "note",
                f"The {modality.title} images are not of one size: {counts}.",
                "That is right for several cameras, and wrong if some were resized.",
            )


def used_twice(evidence: Evidence) -> Iterator[Problem]:
    """Files that serve as several photos."""
    images = [image for view in evidence.scene.train for image in view.images.values()]
    uses = Counter(image.files[0] for image in images if image.files)
    shared = [path for path, count in uses.items() if count > 1]
    if shared:
        yield Problem(
            "warning",
            f"{len(shared)} of {len(uses)} photos are used by several views, or as several "
            f"modalities ({shared[0].name}).",
            "Check that each view has its own.",
        )


def uniform(evidence: Evidence) -> Iterator[Problem]:
    """Images without content."""
    for modality, photos in evidence.photos.items():
        flat = {name: photo for name, photo in photos.items() if photo.spread < _UNIFORM}
        if not flat:
            continue
        what = "uniform: nearly all its pixels have the same value"
        if modality != THERMAL and all(photo.brightest <= _BLACK for photo in flat.values()):
            what = "completely black"
        yield Problem(
            "error" if len(flat) == len(photos) else "warning",
            f"The {modality.title} image of {views_text(list(flat))} is {what} (lens cap?).",
            "Leave these views out, or retake the photos.",
        )


def identical(evidence: Evidence) -> Iterator[Problem]:
    """One photo in many copies."""
    for modality, photos in evidence.photos.items():
        digests = {photo.digest for photo in photos.values()}
        flat = any(photo.spread < _UNIFORM for photo in photos.values())
        if len(digests) == 1 < len(photos) and not flat:
            yield Problem(
                "error",
                f"All {len(photos)} inspected {modality.title} photos are identical, pixel for "
                f"pixel.",
                "Check that each view has its own.",
            )


def few_bits(evidence: Evidence) -> Iterator[Problem]:
    """16-bit images whose values fill a part of the range only: dark ones, and counts."""
    for modality, photos in evidence.photos.items():
        known = [photo.bits for photo in photos.values() if photo.bits is not None]
        if len(known) == len(photos) and known and 8 < max(known) <= 14:
            yield Problem(
                "warning",
                f"The {modality.title} photos use {max(known)} of their 16 bits, so they look dark "
                f"and differ little.",
                "Stretch them to the whole range.",
            )
        elif modality == THERMAL and known and max(p.spread for p in photos.values()) < NARROW:
            yield Problem(
                "warning",
                f"The 16-bit thermal photos use less than {NARROW:.0%} of the range between black "
                f"and white, like counts of a camera.",
                "If they are counts, such as K · 100, convert them to float TIFFs in °C.",
            )


def saturated(evidence: Evidence) -> Iterator[Problem]:
    """Temperatures beyond the scale. Colours may be black or white."""
    photos = evidence.photos.get(THERMAL, {})
    for end, shares in {
        "lower": {name: photo.low_end for name, photo in photos.items()},
        "upper": {name: photo.high_end for name, photo in photos.items()},
    }.items():
        mean = float(np.mean(list(shares.values()))) if shares else 0.0
        if mean > _SATURATED:
            views = [name for name, share in shares.items() if share > 5 * _SATURATED]
            most = f", most in {views_text(views)}" if views else ""
            yield Problem(
                "warning",
                f"{mean:.0%} of the thermal pixels are at the {end} end of the scale{most}: their "
                f"temperatures are lost.",
                "Export the thermal images again with a wider fixed span, or correct "
                "temperature_bounds.json.",
            )


def outside(evidence: Evidence) -> Iterator[Problem]:
    """Temperatures far beyond the scale, as float images can have them."""
    scale = evidence.scene.temperature
    small = {name: photo.small for name, photo in evidence.photos.get(THERMAL, {}).items()}
    shares = {name: ((each < -1) | (each > 2)).float().mean() for name, each in small.items()}
    views = [name for name, share in shares.items() if share > _OUTSIDE]
    if views and scale is not None:
        yield Problem(
            "warning",
            f"In {views_text(views)} temperatures are more than the whole span outside of {scale}.",
            "Correct temperature_bounds.json, or the unit of the thermal images.",
        )


def jumps(evidence: Evidence) -> Iterator[Problem]:
    """Images whose gain or offset differs from that of most."""
    radiometric = any(record.is_radiometric for record in evidence.scene.records)
    for modality, photos in evidence.photos.items():
        relations = agreements(
            [photo.small.numpy() for photo in photos.values()],
            [photo.camera for photo in photos.values()],
            evidence.scene.points,
        )
        pairs = zip(photos, relations, strict=True)
        names = [name for name, relation in pairs if relation is not None and relation.jumps]
        if names:
            yield jump(modality, names, radiometric)


def blurred(evidence: Evidence) -> Iterator[Problem]:
    """Images without fine details. Thermal images have few in any case."""
    for modality, photos in evidence.photos.items():
        known = {name: photo.sharpness for name, photo in photos.items()}
        if modality == THERMAL or len(known) < _FEWEST_TO_COMPARE:
            continue
        limit = _BLURRED * float(np.median(list(known.values())))
        names = [name for name, value in known.items() if value < limit]
        if names:
            yield Problem(
                "warning",
                f"The {modality.title} image of {views_text(names)} is much less sharp than the "
                f"others: motion blur, or out of focus.",
                "Leave these views out, unless nothing else shows what they show.",
            )


FEWEST_VIEWS = 3
"""Fewest images that must see a point to determine its usual value."""

_FEWEST_POINTS = 30
_MOST_POINTS = 3000
_ROUNDS = 3
_JUMP = 0.03
"""Smallest error of an image that jumps, as a share of the set's range."""

_EXPLAINED = 0.6
"""Largest share of that error which remains after gain and offset have been removed."""


@dataclass(frozen=True)
class Agreement:
    """How an image's values relate to the usual values at the same points: value ≈ gain · usual +
    offset. The usual value of a point is the median over the images that see it.

    Attributes:
        error: median distance from the usual value, as a share of the set's range.
        corrected: the error after gain and offset have been removed.
    """

    error: float
    corrected: float

    @property
    def jumps(self) -> bool:
        """Whether the image was taken with another gain or offset than most."""
        return self.error > _JUMP and self.corrected < _EXPLAINED * self.error


def agreements(
    images: Sequence[Float[np.ndarray, "..."] | None],
    cameras: Sequence[Camera | None],
    points: PointCloud,
) -> list[Agreement | None]:
    """The agreement of each image with the others; None where it shares too few points with them.
    Medians over views and points make up for occlusions. The ``images`` are [H, W] each, in one
    unit; NaN where not valid; None for a view without one."""
    positions = points.positions[evenly_spaced(len(points.positions), _MOST_POINTS)].double()
    values = np.full((len(images), len(positions)), np.nan)  # also where an image sees no point
    for row, image, camera in zip(values, images, cameras, strict=True):
        if image is not None and camera is not None:
            pixels, _ = camera.project(positions)
            seen = camera.contains(pixels).numpy()
            x, y = pixels.numpy()[seen].T
            row[seen] = sampled(image.astype(np.float64), x, y)
    usual = np.full(len(positions), np.nan)
    enough = np.isfinite(values).sum(axis=0) >= FEWEST_VIEWS
    usual[enough] = np.nanmedian(values[:, enough], axis=0)
    known = np.isfinite(usual)
    if known.sum() < _FEWEST_POINTS:
        return [None] * len(images)
    low, high = np.quantile(usual[known], [0.02, 0.98])
    span = max(float(high - low), 1e-9)
    return [_agreement((row - low) / span, (usual - low) / span) for row in values]


def _agreement(own: Float[np.ndarray, " n"], usual: Float[np.ndarray, " n"]) -> Agreement | None:
    both = np.isfinite(own) & np.isfinite(usual)
    if both.sum() < _FEWEST_POINTS:
        return None
    x, y = usual[both] - 0.5, own[both] - 0.5
    gain, offset = 1.0, float(np.median(y - x))
    weights = np.ones_like(x)
    for _ in range(_ROUNDS):  # least squares, with less weight where something hides the point
        share = weights / weights.sum()
        mean_x, mean_y = share @ x, share @ y
        variance = share @ (x - mean_x) ** 2
        gain = share @ ((x - mean_x) * (y - mean_y)) / variance if variance > 1e-12 else 1.0
        offset = mean_y - gain * mean_x
        distance = np.abs(y - gain * x - offset)
        weights = 1 / np.maximum(distance, 0.02)
    error = float(np.median(np.abs(y - x)))
    corrected = float(np.median(np.abs(y - gain * x - offset)))
    return Agreement(error, corrected)


def jump(modality: Modality, names: Sequence[str], radiometric: bool) -> Problem:
    """The warning about images that do not agree with the others; only a note for ``radiometric``
    temperatures, whose drift from photo to photo training finds."""
    severity: Severity = "warning"
    changed, cause = "warmer or colder", "as automatic gain or a changed span makes them"
    remedy = "Export all thermal images with one fixed span, or from radiometric files."
    if modality != THERMAL:
        changed, cause = "brighter or darker", "as automatic exposure makes them"
        remedy = "The colours will be a mixture; fix exposure and white balance next time."
    elif radiometric:
        cause = (
            "though the photos are radiometric: the surfaces have warmed or cooled, the camera has "
            "drifted, or its settings were changed"
        )
        remedy = (
            "Training finds an offset for each photo; where the settings differ, leave photos out."
        )
        severity = "note"
    text = f"In {views_text(names)} the same places are {changed} than in the others, {cause}."
    return Problem(severity, text, remedy)
