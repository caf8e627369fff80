"""What scores depend on besides the model: the held-out images, the scale, the training photos."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from mrgs.run_files.fingerprint import ImageFingerprint, changes, fingerprints
from mrgs.scene import Scene, TemperatureRange


class ScoredData(NamedTuple):
    """The data of a run that was scored.

    Attributes:
        temperature: the scene's scale; None without known °C.
        training_photos: digest of the photos that the run was trained on; empty where its
            checkpoint does not name them.
        held_out: of each held-out image, view by view.
    """

    temperature: TemperatureRange | None
    training_photos: str
    held_out: tuple[ImageFingerprint, ...]

    @classmethod
    def of(cls, scene: Scene, trained: Sequence[ImageFingerprint]) -> ScoredData:
        """The data of a scene's scores.

        Raises:
            SceneError: a photo cannot be read.
        """
        photos = "".join(image.photo for image in trained)
        digest = hashlib.sha256(photos.encode()).hexdigest() if photos else ""
        return cls(scene.temperature, digest, fingerprints(_held_out(scene)))

    def to_json(self) -> dict[str, Any]:
        """The object for ``metrics.json``; what is not known has no entry."""
        values: dict[str, Any] = {"held_out": self.held_out}
        if self.training_photos:
            values["training_photos"] = self.training_photos
        if self.temperature is not None:
            values["temperature_c"] = [self.temperature.min_c, self.temperature.max_c]
        return values

    @classmethod
    def from_json(cls, value: Any) -> ScoredData | None:
        """The data from their JSON form; None where it is none, as in older files."""
        try:
            bounds = value.get("temperature_c")
            return cls(
                None if bounds is None else TemperatureRange(*bounds),
                str(value.get("training_photos", "")),
                tuple(map(ImageFingerprint.from_json, value["held_out"])),
            )
        except (AttributeError, KeyError, TypeError, ValueError):
            return None

    def changes(self, now: ScoredData, scene: Scene) -> str:
        """What has changed since the scores were computed, for the user; empty if nothing has."""
        if self.temperature != now.temperature:
            return "it has another temperature range"
        if self.training_photos and self.training_photos != now.training_photos:
            return "training photos"
        if len(self.held_out) != len(now.held_out):
            return f"it has {len(now.held_out)} held-out images, not {len(self.held_out)}"
        return changes(self.held_out, now.held_out, _held_out(scene)) if self.held_out else ""


def _held_out(scene: Scene) -> Scene:
    """The scene's held-out views in the place of those to learn from."""
    return replace(scene, train=scene.eval)
