"""What is odd about a scene that can be read: a training on it works, and teaches little."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from mrgs.data.images import decode
from mrgs.scene import THERMAL, Camera, Modality, PosedImage, Scene
from mrgs.scene.view import evenly_spaced
from mrgs.system.callers import warn
from mrgs.system.wording import listed

PHOTOS = 12
"""How many views' photos are looked at."""

PIXELS = 250_000
"""Of a photo, about so many pixels are looked at, evenly spread."""

LOOKED_AT_PX = 600
"""A JPEG may be decoded at a fraction of its size that is at least so wide."""

POINTS = 20_000
PAIRS = 50_000_000
"""How many of the start points tell which views overlap, and how many pairs of a point and a view
are looked at."""

_FLAT = 1e-4
_BLACK = 1 / 255
_FEWEST_SEEN = 20
_MOST_ALONE = 0.1
"""If the views see fewer points, or a larger share of them overlaps no other, then it is the points
that are too sparse."""

_FEW = 0.05
"""If all views together see a smaller share of the points, poses and points do not fit together."""

_FAR_OFF = 1e4
"""So many times its own size from the origin, a scene's coordinates have few digits left."""

_VIEWS_AT_ONCE = 256
_WHOLE = 1e-2


def oddities(scene: Scene) -> list[str]:
    """One sentence for each oddity of the training views, with what to do.

    Poses are all looked at, and the photos of ``PHOTOS`` views.

    Raises:
        SceneError: a photo cannot be read.
    """
    cameras = scene.train_cameras
    found = [*_of_place(scene, cameras)]
    found += [*_of_poses(cameras)] or [*_of_overlap(scene, cameras)]
    found += _of_files(scene)
    views = [scene.train[place] for place in evenly_spaced(len(scene.train), PHOTOS)]
    for modality in scene.modalities:
        photos = [view.images[modality] for view in views if modality in view.images]
        found += _of_photos(modality, [_thinned(_looked_at(modality, photo)) for photo in photos])
    return found


def warn_of_oddities(scene: Scene) -> None:
    """Warn of each oddity.

    Warns:
        MrgsWarning: see ``oddities``.

    Raises:
        SceneError: a photo cannot be read.
    """
    for text in oddities(scene):
        warn(f"{scene.name}: {text}")


def _of_files(scene: Scene) -> Iterator[str]:
    """Photos that are used as if they were several."""
    images = [image for view in scene.train for image in view.images.values()]
    uses = Counter(image.files[0] for image in images if image.files)
    shared = [path for path, count in uses.items() if count > 1]
    if shared:
        yield (
            f"{len(shared)} of {len(uses)} photos are used by several views, or as several "
            f"modalities ({shared[0].name}): check that each view has its own"
        )


def _of_poses(cameras: Sequence[Camera]) -> Iterator[str]:
    if len(cameras) < 2:
        return
    viewmats = torch.stack([camera.viewmat for camera in cameras])
    distinct = len(torch.unique(viewmats.flatten(1), dim=0))
    if distinct == 1:
        yield (
            f"all {len(cameras)} training views have the same pose, so that depth cannot be found: "
            f"check the poses"
        )
    elif distinct < len(cameras):
        yield (
            f"{len(cameras) - distinct} of {len(cameras)} training views have exactly the pose of "
            f"another: check that each photo has its own"
        )


def far_off(cameras: Sequence[Camera], extent: float) -> float | None:
    """Distance of a scene from the origin, where single precision does not suit it; else None.

    Args:
        cameras: of the scene.
        extent: of the scene.
    """
    centre = torch.stack([camera.position for camera in cameras]).mean(dim=0)
    distance = centre.norm().item()
    return distance if distance > _FAR_OFF * extent else None


def _of_place(scene: Scene, cameras: Sequence[Camera]) -> Iterator[str]:
    """A place whose coordinates single precision does not suit."""
    distance = far_off(cameras, scene.extent)
    if distance is not None:
        yield (
            f"it lies {distance:.2g} units from the origin, but is only {scene.extent:.2g} in "
            f"size: move poses and points to the origin together"
        )


def _of_overlap(scene: Scene, cameras: Sequence[Camera]) -> Iterator[str]:
    """Points that no view sees; or views that see nothing that another one sees."""
    places = evenly_spaced(len(scene.points.positions), min(POINTS, PAIRS // len(cameras)))
    if len(cameras) < 3 or not places:
        return
    sees = _visible(cameras, scene.points.positions[places])
    seen = sees.any(dim=0).float().mean().item()
    if seen < _FEW:
        help_on_axes = (
            "mrgs check says what would"
            if scene.path
            else "cameras take world to camera, with x right, y down and z forward"
        )
        yield (
            f"all training views together see {seen:.0%} of the points: poses and points do not "
            f"fit together, or the axes mean something else; {help_on_axes}"
        )
        return
    seen_by_two = sees.sum(dim=0) >= 2
    counts = sees.sum(dim=1)
    alone = ~(sees & seen_by_two).any(dim=1)
    if counts.median() < _FEWEST_SEEN or alone.float().mean() > _MOST_ALONE:
        return
    names = [scene.train[place].name for place in alone.nonzero().flatten().tolist()]
    if names:
        yield (
            f"{len(names)} of {len(cameras)} training views show nothing that another one shows "
            f"({listed(names)}): check their poses, or leave them out"
        )


def _visible(cameras: Sequence[Camera], points: Float32[Tensor, "n 3"]) -> Bool[Tensor, "v n"]:
    """Which points lie before a camera and in its image."""
    rows = []
    for first in range(0, len(cameras), _VIEWS_AT_ONCE):
        block = cameras[first : first + _VIEWS_AT_ONCE]
        viewmats = torch.stack([camera.viewmat for camera in block]).float()
        K = torch.stack([camera.K for camera in block]).float()
        sizes = torch.tensor([[camera.width, camera.height] for camera in block])
        x, y, depth = (viewmats[:, :3, :3] @ points.T + viewmats[:, :3, 3:]).unbind(dim=1)
        column = K[:, 0, :1] * x / depth + K[:, 0, 2:]
        row = K[:, 1, 1:2] * y / depth + K[:, 1, 2:]
        inside = (column >= 0) & (column < sizes[:, :1]) & (row >= 0) & (row < sizes[:, 1:])
        rows.append(inside & (depth > 0))
    return torch.cat(rows)


def _of_photos(modality: Modality, photos: Sequence[Float32[Tensor, "h w c"]]) -> Iterator[str]:
    if not photos:
        return
    title, count = modality.title, len(photos)
    flat = [photo for photo in photos if bool((_span(photo) < _FLAT).all())]
    if flat:
        black = all(photo.max() <= _BLACK for photo in flat) and modality != THERMAL
        what = "are black" if black else f"hold one {_value_of(modality)} only"
        yield (
            f"{len(flat)} of {count} {title} photos looked at {what}, as behind a lens cap: leave "
            f"them out, or replace them"
        )
    elif count > 1 and len({_digest(photo) for photo in photos}) == 1:
        yield (
            f"all {count} {title} photos looked at are the same, pixel for pixel: check that each "
            f"view has its own"
        )
    bits = _used_bits(photos)
    if bits is not None:
        yield (
            f"the {title} photos use {bits} of their 16 bits, so they look dark and differ little: "
            f"stretch them to the whole range"
        )


def _value_of(modality: Modality) -> str:
    if modality == THERMAL:
        return "temperature"
    return "colour" if modality.channels == 3 else "value"


def _looked_at(modality: Modality, photo: PosedImage) -> Float32[Tensor, "h w c"]:
    """The values of a photo; of a large JPEG file fewer suffice, and nothing is undistorted."""
    if modality == THERMAL or not photo.files:
        return photo.load().values
    return decode(photo.files[0], LOOKED_AT_PX).values


def _thinned(photo: Float32[Tensor, "h w c"]) -> Float32[Tensor, "y x c"]:
    """Every k-th pixel of every k-th row, so that the others need not be kept."""
    step = max(1, math.ceil(math.sqrt(photo.shape[0] * photo.shape[1] / PIXELS)))
    return photo[::step, ::step].clone()


def _span(photo: Float32[Tensor, "h w c"]) -> Float32[Tensor, " c"]:
    """The range of each channel."""
    return photo.amax(dim=(0, 1)) - photo.amin(dim=(0, 1))


def _digest(photo: Float32[Tensor, "h w c"]) -> bytes:
    return hashlib.sha256(photo.numpy().tobytes()).digest()


def _used_bits(photos: Sequence[Float32[Tensor, "h w c"]]) -> int | None:
    """How many of their 16 bits photos use, where that is 14 or fewer; None for all others.

    Photos that were undistorted or reduced do not tell how many bits they had.
    """
    values = np.concatenate([photo.numpy().ravel() for photo in photos]).astype(np.float64)
    levels = values * 65535
    largest = round(float(levels.max()))
    has_16_bits = _are_whole(levels) and not _are_whole(values * 255)
    bits = largest.bit_length()
    return bits if has_16_bits and 8 < bits <= 14 else None


def _are_whole(values: np.ndarray) -> bool:
    return bool((np.abs(values - np.rint(values)) < _WHOLE).all())
