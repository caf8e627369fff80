"""What a run was trained on: a digest of each training photo, and its camera. A resumed run is the
same run only if these are the same."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from mrgs.data.kept import digest
from mrgs.errors import SceneError
from mrgs.scene import PosedImage, Scene
from mrgs.system.wording import listed

SAME = 1e-6
"""Relative difference up to which cameras count as equal: other machines round differently."""

ROUNDING = 1e-9
"""The same relative to the largest of the compared numbers, for numbers near 0."""

_READERS = 4
"""Number of threads that read photos."""


class ImageFingerprint(NamedTuple):
    """Identifies one training image.

    Attributes:
        photo: digest of its files (the photo, and its mask if it has one).
        pose: the upper three rows of the camera's viewmat, row by row.
        intrinsics: fx, fy, cx, cy, width and height in pixels.
    """

    photo: str
    pose: tuple[float, ...]
    intrinsics: tuple[float, ...]

    @classmethod
    def from_json(cls, value: Any) -> ImageFingerprint:
        """A fingerprint from its JSON form.

        Raises:
            TypeError, ValueError: the value is not a fingerprint.
        """
        photo, pose, intrinsics = value
        if not isinstance(photo, str) or len(pose) != 12 or len(intrinsics) != 6:
            raise ValueError("not a fingerprint of an image")
        return cls(photo, tuple(map(float, pose)), tuple(map(float, intrinsics)))


def fingerprints(scene: Scene) -> tuple[ImageFingerprint, ...]:
    """Fingerprints of all training images, view by view.

    Raises:
        SceneError: a photo cannot be read.
    """
    with ThreadPoolExecutor(_READERS) as pool:
        return tuple(pool.map(_fingerprint, (image for _, image in _training_images(scene))))


def changes(
    before: Sequence[ImageFingerprint], now: Sequence[ImageFingerprint], scene: Scene
) -> str:
    """What has changed since a run began, for a message; empty if nothing has. The fingerprints are
    those of the scene's images at the start and now."""
    pairs = list(zip(before, now, strict=True))
    names = [name for name, _ in _training_images(scene)]
    found = {
        "photos": [old.photo != new.photo for old, new in pairs],
        "poses": [_differ(old.pose, new.pose) for old, new in pairs],
        "intrinsics": [_differ(old.intrinsics, new.intrinsics) for old, new in pairs],
    }
    parts = []
    for what, differs in found.items():
        where = [name for name, is_other in zip(names, differs, strict=True) if is_other]
        if where:
            parts.append(f"{what} of {listed(where)}")
    return "; ".join(parts)


def _training_images(scene: Scene) -> Iterator[tuple[str, PosedImage]]:
    """Each training image, with the names of its view and its modality."""
    for view in scene.train:
        for modality, image in view.images.items():
            yield f"{view.name} ({modality})", image


def _fingerprint(image: PosedImage) -> ImageFingerprint:
    """The photo's digest is of its files, or of its values and mask if it was made from arrays."""
    found = hashlib.sha256()
    for path in image.files:
        if not (of_file := digest(path)):
            raise SceneError(f"{path} cannot be read: check its permissions")
        found.update(bytes.fromhex(of_file))
    if not image.files:
        for tensor in (pixels := image.load()).values, pixels.valid:
            content = b"" if tensor is None else tensor.numpy().tobytes()
            found.update(hashlib.sha256(content).digest())
    K, viewmat = image.camera.K, image.camera.viewmat
    lens = (*K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), image.camera.width, image.camera.height)
    pose = tuple(viewmat[:3].flatten().tolist())
    return ImageFingerprint(found.hexdigest(), pose, tuple(map(float, lens)))


def _differ(some: Sequence[float], others: Sequence[float]) -> bool:
    rounding = ROUNDING * max(map(abs, others))
    return not np.allclose(some, others, rtol=SAME, atol=rounding)
