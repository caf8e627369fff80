"""Rules for a scene's photos, and the statistics that they judge."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from mrgs.check.agreement import agreements, jump
from mrgs.check.problem import (
    Evidence,
    ImageStatistics,
    Problem,
    Severity,
    cameras_by_modality,
    views_text,
)
from mrgs.data.images import LUMINANCE, decode
from mrgs.data.undistort import reduced
from mrgs.scene import RGB, THERMAL, Camera, Modality, Pixels, PosedImage, Scene
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
"""A normalised value nearer than this to 0 or 1 (a quarter of an 8-bit step) is at the end of the
scale."""

_SATURATED = 0.02
"""Share of a set's thermal pixels that gives a warning; a view is named at five times that."""

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

    Raises:
        SceneError: a photo cannot be read.
    """
    views = [scene.train[place] for place in evenly_spaced(len(scene.train), FEW_VIEWS)]
    return {
        modality: {
            view.name: measure(_fast_pixels(modality, view.images[modality]), view.images[modality])
            for view in views
            if modality in view.images
        }
        for modality in scene.modalities
    }


def _fast_pixels(modality: Modality, photo: PosedImage) -> Pixels:
    """A photo's pixels, not undistorted where that would require reading a large file whole."""
    if modality == THERMAL or not photo.files:
        return photo.load()
    return Pixels(decode(photo.files[0], FAST_WIDTH_PX).values)


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
        camera=photo.camera.with_width(min(photo.camera.width, small.shape[1])),
    )


def sharpness(image: Float[np.ndarray, "h w"]) -> float:
    """Share of an image's contrast in its finest details: 0 for a smooth image, about 1 for a crisp
    one.

    The mean squared difference between neighbours over that at half the resolution, in the
    direction where it is smaller: motion blurs in one direction. It hardly depends on the content.
    """
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
    """Views that lack an image of a modality."""
    views, present = evidence.scene.views, cameras_by_modality(evidence.scene)
    for modality in in_order((*_EXPECTED, *present)):
        title = modality.title
        lacking = [view.name for view in views if modality not in view.images]
        if modality not in present:
            severity, what = _EXPECTED[modality]
            text = f"No view has any {title} image: the model will have no {what}."
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
    """16-bit images whose values fill a part of the range only."""
    for modality, photos in evidence.photos.items():
        known = [photo.bits for photo in photos.values() if photo.bits is not None]
        if len(known) == len(photos) and known and 8 < max(known) <= 14:
            yield Problem(
                "warning",
                f"The {modality.title} photos use {max(known)} of their 16 bits, so they look dark "
                f"and differ little.",
                "Stretch them to the whole range.",
            )


def saturated(evidence: Evidence) -> Iterator[Problem]:
    """Temperatures beyond the scale. Colours may be black or white."""
    photos = evidence.photos.get(THERMAL, {})
    for end, shares in (
        ("lower", {name: photo.low_end for name, photo in photos.items()}),
        ("upper", {name: photo.high_end for name, photo in photos.items()}),
    ):
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


def jumps(evidence: Evidence) -> Iterator[Problem]:
    """Images whose gain or offset differs from that of most."""
    radiometric = any(record.is_radiometric for record in evidence.scene.records)
    for modality, photos in evidence.photos.items():
        images: list[tuple[Float32[Tensor, "h w"], Camera]] = [
            (photo.small, photo.camera) for photo in photos.values()
        ]
        relations = agreements(
            [small.numpy() for small, _ in images],
            [camera for _, camera in images],
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
