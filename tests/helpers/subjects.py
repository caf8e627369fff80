"""What the viewer shows."""

from __future__ import annotations

from pathlib import Path

from mrgs.runs.open import Run
from mrgs.scene import Scene
from mrgs.viewer.settings import Subject
from mrgs.viewer.source import TrainedSource


def subject_of(run: Run, scene: Scene | None, folder: Path) -> Subject:
    """A run as the viewer's subject; what it writes goes into the folder."""
    return Subject("balls", TrainedSource(run.model), run.temperature, scene, folder)
