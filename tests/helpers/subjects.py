"""What the viewer shows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mrgs.marks.store import CameraSpread
from mrgs.runs.open import Run
from mrgs.scene import RGB, THERMAL, Scene
from mrgs.viewer.server import board_of, uncertainty_of
from mrgs.viewer.settings import Mode, Subject, shown_modalities
from mrgs.viewer.source import TrainedSource

MODES = {
    "temperature": Mode("image", (THERMAL,)),
    "colour": Mode("image", (RGB,)),
    "depth": Mode("depth"),
    "uncertainty": Mode("uncertainty", (THERMAL,)),
    "side_by_side": Mode("side_by_side", (RGB, THERMAL)),
    "blend": Mode("blend", (RGB, THERMAL)),
    "split": Mode("split", (RGB, THERMAL)),
    "photos": Mode("photos", (RGB, THERMAL)),
    "difference": Mode("difference", (THERMAL,)),
}
"""The modes of a run with RGB and thermal photos, in the panel's order."""


def subject_of(run: Run, scene: Scene | None, folder: Path) -> Subject:
    """A run as the viewer's subject; what it writes goes into the folder."""
    source, modalities = TrainedSource(run.model), shown_modalities(run.model, scene)
    subject = Subject("balls", source, modalities, run.temperature, scene, folder)
    own = replace(run, folder=type(run.folder)(folder))
    board = board_of(subject, CameraSpread.of_run(run), own)
    return replace(subject, board=board, uncertainty=uncertainty_of(subject, board))
