"""Checks that each modality was photographed with one camera: a scene cannot mix several."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence

from mrgs.data.files import scene_error
from mrgs.prepare.pairs.inventory import Inventory
from mrgs.prepare.pairs.names import PARTNER, REFERENCE
from mrgs.prepare.pairs.photo import Photo
from mrgs.prepare.pairs.rules import Pair
from mrgs.scene import Modality

_ZOOM = 1.02
"""Focal lengths whose ratio is larger are those of a zoom, not of rounding."""


def check_cameras(pairs: Sequence[Pair], inventory: Inventory) -> tuple[str, ...]:
    """Warnings about the cameras of the pairs.

    Raises:
        SceneError: the photos of a modality are of two cameras or of two sizes.
    """
    partners = [pair.partner for pair in pairs if pair.partner is not None]
    embedded = [pair.reference for pair in pairs if pair.partner is None]
    if partners and embedded:
        raise scene_error(
            inventory.root,
            f"the {PARTNER.title} photos are of different cameras: that of "
            f"{inventory.name(embedded[0])} is embedded, {inventory.name(partners[0])} is a file "
            f"of its own; use one of the two kinds",
        )
    for modality in (PARTNER, REFERENCE):
        photos = [pair.photos[modality] for pair in pairs if modality in pair.photos]
        for attribute in (lambda photo: photo.exif.model, lambda photo: photo.size):
            _check_alike(modality, photos, attribute, inventory)
    return _zoomed(partners)


def _check_alike(
    modality: Modality,
    photos: Sequence[Photo],
    attribute: Callable[[Photo], Hashable],
    inventory: Inventory,
) -> None:
    groups: dict[Hashable, list[Photo]] = {}
    for photo in photos:
        if (value := attribute(photo)) is not None:
            groups.setdefault(value, []).append(photo)
    if len(groups) < 2:
        return
    most, other = sorted(groups.values(), key=len, reverse=True)[:2]
    raise scene_error(
        inventory.root,
        f"the {modality.title} photos are of {len(groups)} cameras or sizes: {len(most)} of "
        f"{_described(most[0], inventory)}, and "
        f"{len(other)} of {_described(other[0], inventory)}; prepare each camera "
        f"separately, from a folder of its own",
    )


def _described(photo: Photo, inventory: Inventory) -> str:
    size = "" if photo.size is None else f" with {photo.size[0]} x {photo.size[1]} pixels"
    return f"{photo.exif.model or 'a camera'}{size} such as {inventory.name(photo)}"


def _zoomed(photos: Sequence[Photo]) -> tuple[str, ...]:
    focal_mm = [photo.focal_mm for photo in photos if photo.focal_mm is not None]
    if not focal_mm or max(focal_mm) <= _ZOOM * min(focal_mm):
        return ()
    return (
        f"The {PARTNER.title} photos were taken with focal lengths of {min(focal_mm):g} mm to "
        f"{max(focal_mm):g} mm, yet one "
        "lens is assumed for all: leave out those that were zoomed.",
    )
