"""The facts about a run in its checkpoints, and whether a scene is the one it was trained on."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from mrgs.errors import RunError, SceneError, warn_user
from mrgs.run_files.fingerprint import ImageFingerprint, changes, fingerprints
from mrgs.scene import RGB, THERMAL, Modality, Scene, TemperatureRange
from mrgs.scene.capture import Capture, model_modalities


class CheckpointFacts(NamedTuple):
    """The facts about a run in the headers of its checkpoints.

    Attributes:
        step: steps done.
        scene: absolute path of the scene's folder; empty for a scene made from arrays.
        capture: what the model needs to know of the scene's photos.
        temperature: the scene's temperature scale; None without known °C.
        train_seconds: time spent in training so far.
        peak_memory_bytes: largest memory of the process since the run came to ``device``; on a GPU
            that of its tensors there.
        skipped_steps: steps skipped so far because of values that were not finite.
        device: device of the last step: a GPU's name, or "cpu".
        modalities: of the scene's images.
        images: fingerprint of each training image, by view and modality.
    """

    step: int
    scene: str
    capture: Capture
    temperature: TemperatureRange | None
    train_seconds: float
    peak_memory_bytes: int
    skipped_steps: int
    device: str = "cpu"
    modalities: tuple[Modality, ...] = (RGB, THERMAL)
    images: tuple[ImageFingerprint, ...] = ()

    @classmethod
    def at_start(cls, scene: Scene) -> CheckpointFacts:
        """The facts before the first step on a scene.

        Raises:
            SceneError: a photo cannot be read.
        """
        capture, images = Capture.of(scene), fingerprints(scene)
        return cls(
            0, scene.path, capture, scene.temperature, 0.0, 0, 0, "cpu", scene.modalities, images
        )

    def photographed(self, modalities: Iterable[Modality]) -> tuple[Modality, ...]:
        """The given modalities of which the scene has photos."""
        return tuple(each for each in modalities if each in self.modalities)

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
        """The facts in a header, which may have other entries too.

        Raises:
            KeyError, TypeError, ValueError: one is missing, or is not what it should be.
        """
        values = {name: header[name] for name in cls._fields}
        for name in ("step", "peak_memory_bytes", "skipped_steps"):
            if type(values[name]) is not int or values[name] < 0:
                raise ValueError(f"{name} is a number of at least 0")
        seconds = values["train_seconds"] = float(values["train_seconds"])
        if not 0 <= seconds < math.inf:
            raise ValueError("train_seconds is a time")
        if not isinstance(values["scene"], str) or not isinstance(values["device"], str):
            raise TypeError("the scene is a path, the device a name")
        bounds = values["temperature"]
        values["temperature"] = None if bounds is None else TemperatureRange(*bounds)
        values["capture"] = Capture.from_json(values["capture"])
        values["modalities"] = tuple(map(Modality.from_json, values["modalities"]))
        values["images"] = tuple(map(ImageFingerprint.from_json, values["images"]))
        return cls(**values)


def require_scene(scene: object) -> None:
    """Check that an argument is a scene or its folder.

    Raises:
        SceneError: it is something else.
    """
    if not isinstance(scene, (Scene, str, os.PathLike)):
        raise SceneError(
            f"the scene must be a Scene or its folder, not {type(scene).__name__}: make one with "
            f"Scene.from_arrays",
            options=("scene",),
        )


def require_same_scene(facts: CheckpointFacts, scene: Scene) -> None:
    """Check that a scene has the cameras and the temperatures that its run was trained with.

    Raises:
        RunError: it has others.
    """
    _raise_first(scene, _other_views(facts, scene))
    if not math.isclose(facts.capture.extent, scene.extent, rel_tol=1e-6):
        _raise_first(scene, [("has other cameras than the run's scene", _AS_IT_WAS)])
    _raise_first(scene, _other_temperatures(facts, scene))


def facts_to_resume(
    facts: CheckpointFacts, scene: Scene, accept_changes: bool = False
) -> CheckpointFacts:
    """The facts of a checkpoint that is resumed, updated to its scene as it is now.

    Args:
        facts: of the checkpoint.
        scene: to train on.
        accept_changes: continue although photos, poses or intrinsics have changed.

    Warns:
        MrgsWarning: they have changed, which is accepted.

    Raises:
        RunError: they have changed, which is not accepted; or the scene has another number of
            images, another temperature range or more modalities.
    """
    _raise_first(scene, _incompatible(facts, scene))
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
    return facts._replace(scene=scene.path, capture=Capture.of(scene), images=images)


def differences(facts: CheckpointFacts, scene: Scene) -> str:
    """How a scene differs from the run's, for a message; empty if it does not.

    Raises:
        SceneError: a photo cannot be read.
    """
    for what, _ in _incompatible(facts, scene):
        return f"it {what}"
    return changes(facts.images, fingerprints(scene), scene)


_AS_IT_WAS = "use that scene as it was"


def _raise_first(scene: Scene, problems: Iterable[tuple[str, str]]) -> None:
    for what, remedy in problems:
        raise RunError(f"{scene.name} {what}: {remedy}")


def _incompatible(facts: CheckpointFacts, scene: Scene) -> Iterator[tuple[str, str]]:
    """Why a run cannot go on with a scene, each with a remedy."""
    yield from _other_views(facts, scene)
    yield from _other_temperatures(facts, scene)
    untrained = set(scene.modalities) - set(model_modalities(facts.modalities))
    if untrained:
        names = ", ".join(sorted(each.name for each in untrained))
        yield f"has images that the run began without ({names})", "retrain"


def _other_views(facts: CheckpointFacts, scene: Scene) -> Iterator[tuple[str, str]]:
    """How the numbers of a scene's images differ from the run's, or its thermal views."""
    trained = model_modalities(facts.modalities)
    count = sum(modality in trained for view in scene.train for modality in view.images)
    thermal = [THERMAL in view.images for view in scene.train]
    if (facts.capture.views, len(facts.images)) != (len(scene.train), count):
        yield (
            f"has {len(scene.train)} training views of {count} images, not the "
            f"{facts.capture.views} that the run was trained with",
            _AS_IT_WAS,
        )
    elif thermal != [point is not None for point in facts.capture.thermal_viewpoints]:
        yield "has thermal photos in other views than the run was trained with", _AS_IT_WAS


def _other_temperatures(facts: CheckpointFacts, scene: Scene) -> Iterator[tuple[str, str]]:
    if facts.temperature != scene.temperature:
        yield (
            "has another temperature range than the run was trained with",
            "bring back the one that it had, or retrain",
        )
