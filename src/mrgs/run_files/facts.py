"""The facts about a run in its checkpoints, and whether a scene is the one it was trained on."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np

from mrgs.data.kept import digest
from mrgs.errors import RunError, SceneError, warn_user
from mrgs.scene import RGB, THERMAL, Modality, PosedImage, Scene, TemperatureRange
from mrgs.scene.capture import Capture, model_modalities
from mrgs.system.typed_json import Count, NotNegative, from_json
from mrgs.system.wording import listed

SAME = 1e-6
"""Relative difference up to which cameras count as equal: other machines round differently."""

ROUNDING = 1e-9
"""The same difference relative to the largest of the compared numbers, for numbers near 0."""

_READERS = 4
"""Number of threads that read photos."""


class ImageFingerprint(NamedTuple):
    """Identifies one training image: the digest of its files (the photo, and its mask if it has
    one); the upper three rows of the camera's viewmat, row by row; and fx, fy, cx, cy, width and
    height in pixels."""

    photo: str
    pose: Annotated[tuple[float, ...], msgspec.Meta(min_length=12, max_length=12)]
    intrinsics: Annotated[tuple[float, ...], msgspec.Meta(min_length=6, max_length=6)]


def fingerprints(scene: Scene) -> tuple[ImageFingerprint, ...]:
    """Fingerprints of all training images, view by view. SceneError if a photo cannot be read."""
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


class CheckpointFacts(NamedTuple):
    """The facts about a run in the headers of its checkpoints.

    Attributes:
        scene: absolute path of the scene's folder; empty for a scene made from arrays.
        capture: what the model needs to know of the scene's photos.
        temperature: the scene's temperature scale; None without known °C.
        peak_memory_bytes: largest memory of the process since the run came to ``device``; on a GPU
            that of its tensors there.
        skipped_steps: steps skipped so far because of values that were not finite.
        device: device of the last step: a GPU's name, or "cpu".
        modalities: of the scene's images.
        images: fingerprint of each training image, by view and modality.
    """

    step: Count
    scene: str
    capture: Capture
    temperature: TemperatureRange | None
    train_seconds: NotNegative
    peak_memory_bytes: Count
    skipped_steps: Count
    device: str = "cpu"
    modalities: tuple[Modality, ...] = (RGB, THERMAL)
    images: tuple[ImageFingerprint, ...] = ()

    @classmethod
    def at_start(cls, scene: Scene) -> CheckpointFacts:
        """The facts before the first step on a scene. SceneError if a photo cannot be read."""
        capture, images = Capture.of(scene), fingerprints(scene)
        return cls(
            0, scene.path, capture, scene.temperature, 0.0, 0, 0, "cpu", scene.modalities, images
        )

    def moved_to(self, path: str | Path | None) -> CheckpointFacts:
        """These facts with the scene's current path, if one is given."""
        return self if path is None else self._replace(scene=str(Path(path).resolve()))

    def to_json(self) -> dict[str, Any]:
        """The facts for a header; ``from_json`` reads them."""
        temperature = self.temperature
        return {
            **self._asdict(),
            "capture": asdict(self.capture),
            "modalities": [modality.to_json() for modality in self.modalities],
            "temperature": None if temperature is None else [temperature.min_c, temperature.max_c],
        }

    @classmethod
    def from_json(cls, header: Mapping[str, Any]) -> CheckpointFacts:
        """The facts in a header, which may have other entries too. KeyError, TypeError or
        ValueError if one is missing, or is not what it should be."""
        values = {name: header[name] for name in cls._fields}
        if (bounds := values["temperature"]) is not None:
            values["temperature"] = dict(zip(("min_c", "max_c"), bounds, strict=True))
        return from_json(cls, [*values.values()])


def require_scene(scene: object) -> None:
    """Check that an argument is a scene or its folder. SceneError if it is not."""
    if not isinstance(scene, (Scene, str, os.PathLike)):
        raise SceneError(
            f"the scene must be a Scene or its folder, not {type(scene).__name__}: make one with "
            f"Scene.from_arrays",
            options=("scene",),
        )


def require_same_scene(facts: CheckpointFacts, scene: Scene) -> None:
    """Check that a scene has its run's cameras and temperatures. RunError if it does not."""
    problems = [*_mismatches(facts, scene)]
    if not math.isclose(facts.capture.extent, scene.extent, rel_tol=1e-6):
        problems.append(("has other cameras than the run's scene", _AS_IT_WAS))
    _raise_first(scene, problems)


def facts_to_resume(
    facts: CheckpointFacts, scene: Scene, accept_changes: bool = False
) -> CheckpointFacts:
    """The facts of a checkpoint that is resumed, updated to its scene as it is now. RunError if the
    scene has another number of images, another temperature range or more modalities. Other photos,
    poses or intrinsics are a MrgsWarning if ``accept_changes``, else a RunError."""
    _raise_first(scene, incompatibilities(facts, scene))
    images = fingerprints(scene)
    if changed := changes(facts.images, images, scene):
        if not accept_changes:
            raise RunError(
                f"{scene.name} has changed since the run began ({changed}): bring back what was, "
                f"or accept the changes",
                options=("accept_changes",),
            )
        warn_user(
            f"{scene.name} has changed since the run began ({changed}); training goes on with it "
            f"as it is now"
        )
    before = facts.capture  # what the model was trained with, and goes on with
    capture = replace(Capture.of(scene), radiance=before.radiance, air=before.air)
    return facts._replace(scene=scene.path, capture=capture, images=images)


_AS_IT_WAS = "use that scene as it was"


def _raise_first(scene: Scene, problems: Iterable[tuple[str, str]]) -> None:
    for what, remedy in problems:
        raise RunError(f"{scene.name} {what}: {remedy}")


def incompatibilities(facts: CheckpointFacts, scene: Scene) -> Iterator[tuple[str, str]]:
    """Why a run cannot go on with a scene, each with a remedy."""
    yield from _mismatches(facts, scene)
    untrained = set(scene.modalities) - set(model_modalities(facts.modalities))
    if untrained:
        names = ", ".join(sorted(each.name for each in untrained))
        yield f"has images that the run began without ({names})", "retrain"


def _mismatches(facts: CheckpointFacts, scene: Scene) -> Iterator[tuple[str, str]]:
    """How the images' numbers, the thermal views or the temperatures differ from the run's."""
    trained = model_modalities(facts.modalities)
    count = sum(modality in trained for view in scene.train for modality in view.images)
    thermal = [THERMAL in view.images for view in scene.train]
    if (facts.capture.views, len(facts.images)) != (len(scene.train), count):
        yield (
            f"has {len(scene.train)} training views of {count} images, not "
            f"{facts.capture.views} of {len(facts.images)} as the run was trained with",
            _AS_IT_WAS,
        )
    elif thermal != [point is not None for point in facts.capture.thermal_viewpoints]:
        yield "has thermal photos in other views than the run was trained with", _AS_IT_WAS
    if facts.temperature != scene.temperature:
        yield (
            "has another temperature range than the run was trained with",
            "bring back the one that it had, or retrain",
        )
