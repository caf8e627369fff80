"""Checks that each modality was photographed with one camera: a scene cannot mix several."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TypeVar

import numpy as np
from scipy.spatial import cKDTree

from mrgs.errors import SceneError, printable, scene_error
from mrgs.prepare.contract import MIN_VIEWS, SeveralCamerasError, Skipped
from mrgs.prepare.pairs.inventory import Inventory
from mrgs.prepare.pairs.photo import PARTNER, REFERENCE, Photo
from mrgs.prepare.pairs.rules import NEARLY, Match, Pair
from mrgs.scene import Modality
from mrgs.system.wording import counted, listed, shown

Value = TypeVar("Value", bound=Hashable)

_ZOOM = 1.02
"""Focal lengths whose ratio is larger are those of a zoom, not of rounding."""

MOST_NAMED = 5
"""Cameras in one message."""

_OTHER_LENS = 1.2
"""Fields of view whose ratio is larger are those of two lenses, not of one focused differently."""


UNKNOWN_CAMERA = "does not say which camera took it"
"""Why a thermal photo is left out whose file names no camera and whose size fits none alone."""


def check_cameras(
    pairs: Sequence[Pair], inventory: Inventory, camera: str | None
) -> tuple[str, ...]:
    """Warnings about the cameras of the pairs, after ``of_one_camera``. SceneError if the photos of
    a modality are of two models of camera, two lenses or two sizes."""
    partners = [pair.partner for pair in pairs if pair.partner is not None]
    embedded = [pair.reference for pair in pairs if pair.partner is None]
    if partners and embedded:
        raise scene_error(
            inventory.root,
            f"the {PARTNER.title} photos are of different cameras: that of "
            f"{embedded[0].name} is embedded, {partners[0].name} is a file "
            f"of its own; use one of the two kinds",
        )
    warnings: tuple[str, ...] = ()
    for modality in (PARTNER, REFERENCE):
        photos = [pair.photos[modality] for pair in pairs if modality in pair.photos]
        if len(cameras := _by_camera(photos)) > 1:
            of_each = [
                f"{len(own)} of {name} such as {own[0].name}"
                for name, own in sorted(cameras.items(), key=lambda each: -len(each[1]))
            ]
            raise scene_error(
                inventory.root,
                f"the {modality.title} photos are of {len(cameras)} cameras, lenses or sizes: "
                f"{listed(of_each, MOST_NAMED)}; prepare each separately, from a folder of its own",
                options=("camera",) if modality == REFERENCE and camera is None else (),
            )
        focal_mm = [photo.focal_mm for photo in photos if photo.focal_mm is not None]
        if focal_mm and max(focal_mm) > _ZOOM * min(focal_mm):
            warnings += (
                f"The {modality.title} photos were taken with focal lengths of {min(focal_mm):g} "
                f"mm to {max(focal_mm):g} mm, yet one lens is assumed for all: leave out those "
                f"that were zoomed.",
            )
        warnings += _several(modality, photos)
    unknown = [item.name for item in inventory.skipped if item.reason == UNKNOWN_CAMERA]
    if unknown:
        count = counted(len(unknown), f"{REFERENCE.title} photo")
        warnings += (
            f"Files that do not say which camera took them are left out: {count}, such as "
            f"{printable(unknown[0])}. Prepare each camera from a folder of its own.",
        )
    return warnings


def of_one_camera(
    inventory: Inventory, camera: str | None, match: Callable[[Inventory], Match]
) -> Inventory:
    """The inventory without the photos of other thermal cameras than the chosen one, and without
    RGB photos of their models; all of it where none is chosen. A thermal photo that names no camera
    is of the one whose photos alone have its size. SceneError if there is no such
    camera. SeveralCamerasError if none is chosen, and several have pairs enough for a scene where
    each is matched apart: the rule for all photos may find only the pairs of one."""
    references = inventory.references
    cameras = _by_camera(references)
    candidates = _candidates(references, cameras)

    def only(name: str) -> Inventory:
        left_out = {
            photo: f"is not of {name}" if names and name not in names else UNKNOWN_CAMERA
            for photo, names in candidates.items()
            if names != [name]
        }
        others = [each for each in inventory.others if each.exif.model in cameras.keys() - {name}]
        left_out |= dict.fromkeys(others, f"is not of {name}")
        skipped = [Skipped(each.name, reason) for each, reason in left_out.items()]
        kept = tuple(each for each in inventory.photos if each not in left_out)
        return replace(inventory, photos=kept, skipped=(*inventory.skipped, *skipped))

    if camera in cameras:
        return only(camera)
    names = listed([*cameras], MOST_NAMED) or "unknown cameras"
    if camera is not None:
        text = f"no thermal photo is of {shown(camera)}: they are of {names}"
        raise scene_error(inventory.root, text, options=("camera",))
    enough = []
    for name in cameras if len(cameras) > 1 else ():
        with suppress(SceneError):  # no pairs
            enough += [name] if len(match(only(name)).pairs) >= MIN_VIEWS else []
    if len(enough) > 1:
        text = f"{inventory.root}: the thermal photos are of {names}, and a scene has one camera"
        raise SeveralCamerasError(f"{text}: choose one", tuple(enough))
    return inventory


def _candidates(
    photos: Sequence[Photo], cameras: Mapping[str, Sequence[Photo]]
) -> dict[Photo, list[str]]:
    """The cameras that each photo may be of: its own, or if it names none, those with its size."""
    known = {photo: [name] for name, own in cameras.items() for photo in own}
    sizes = {name: {photo.size for photo in own} - {None} for name, own in cameras.items()}
    return {
        photo: known.get(photo) or [name for name in cameras if photo.size in sizes[name]]
        for photo in photos
    }


def _by_camera(photos: Sequence[Photo]) -> dict[str, list[Photo]]:
    """The photos by the models of their cameras, or where these do not differ by their sizes, else
    by their lenses; without those whose files do not tell."""
    lenses: dict[float | None, str] = {}
    narrow = 0.0
    for degrees in sorted(each.field_of_view_deg for each in photos if each.field_of_view_deg):
        narrow = degrees if degrees > _OTHER_LENS * narrow else narrow
        lenses[degrees] = f"{narrow:.0f}°"
    models = _grouped(photos, lambda photo: photo.exif.model)
    sizes = _grouped(photos, lambda photo: photo.size and "{} x {}".format(*photo.size))
    by_lens = _grouped(photos, lambda photo: lenses.get(photo.field_of_view_deg))
    return next((each for each in (models, sizes, by_lens) if len(each) > 1), models)


def _grouped(
    photos: Sequence[Photo], attribute: Callable[[Photo], Value | None]
) -> dict[Value, list[Photo]]:
    """The photos by an attribute, where it is known."""
    groups: dict[Value, list[Photo]] = {}
    for photo in photos:
        if (value := attribute(photo)) is not None:
            groups.setdefault(value, []).append(photo)
    return groups


def _several(modality: Modality, photos: Sequence[Photo]) -> tuple[str, ...]:
    """A warning about cameras of one model with serial numbers of their own."""
    by_serial = _grouped(photos, lambda photo: photo.serial)
    if len(by_serial) < 2:
        return ()
    most, other = sorted(by_serial.items(), key=lambda group: -len(group[1]))[:2]
    named = " and ".join(
        f"{serial} ({len(own)}, such as {own[0].name})" for serial, own in (most, other)
    )
    return (
        f"The {modality.title} photos are of {len(by_serial)} cameras of one model, by their "
        f"serial numbers {named}, yet one lens and one offset is assumed for all: prepare each "
        f"camera separately, from a folder of its own.",
    )


_FEWEST_TIMED, _FEWEST_SHIFTED = 5, 2
_NEARER_S = 2.0
"""Seconds by which the partner of a doubted pair was taken nearer to another photo, and the least
numbers of pairs with times and of doubted pairs for a warning."""


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
    nearest_s = cKDTree(references_s[:, None]).query(aligned_s[:, None])[0]
    wrong = (gaps_s > nearest_s + _NEARER_S).nonzero()[0]
    if len(wrong) < max(_FEWEST_SHIFTED, (1 - NEARLY) * len(timed)):
        return ()
    names = [printable(photo.path.name) for photo in timed[wrong[0]][0].photos.values()]
    return (
        f"By their times {len(wrong)} of {len(timed)} pairs were not taken together, such as "
        f"{' and '.join(names)}: a photo may be missing in the row. Pair by time, or list the "
        f"pairs in a CSV file.",
    )
