"""Whether a run was trained and scored on the data that its scene holds now."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from mrgs.comparison.single import Scores
from mrgs.errors import ConfigError, RunError
from mrgs.evaluation.scored_data import ScoredData
from mrgs.scene import Scene
from mrgs.training.checkpoint import load_facts
from mrgs.training.facts import CheckpointFacts, differences
from mrgs.training.run_folder import RunFolder


class SceneData:
    """What a scene holds now; its photos are read once, when a run is compared with it."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    @cached_property
    def facts(self) -> CheckpointFacts:
        """The facts of a run that began now."""
        return CheckpointFacts.at_start(self.scene)

    @cached_property
    def scored(self) -> ScoredData:
        """The data of scores that were computed now."""
        return ScoredData.of(self.scene, self.facts.images)


def require_same_data(folder: Path, data: SceneData, scores: Scores | None) -> None:
    """A folder that holds a run holds one of what its scene holds now, as far as the run says it.

    Held-out images may differ where a checkpoint is there, which can be scored again.

    Args:
        folder: of the run.
        data: of its scene.
        scores: in the folder.

    Raises:
        ConfigError: it was trained, or scored, on other data; the message says what has changed.
        SceneError: a photo cannot be read.
    """
    facts = _facts_of(folder)
    changed = _scores_differ(scores, data) if facts is None else _trained_differ(facts, data)
    if changed:
        raise ConfigError(
            f"{folder} holds a run of other data than {data.scene.name} has now ({changed}): "
            f"choose another folder, or remove this one",
            options=("output",),
        )


def are_stale(scores: Scores | None, data: SceneData) -> bool:
    """Whether scores are of other data than their scene has now.

    Raises:
        SceneError: a photo cannot be read.
    """
    return bool(_scores_differ(scores, data))


def _facts_of(folder: Path) -> CheckpointFacts | None:
    """The facts of a run's newest checkpoint that can be read; None if there is none."""
    found = map(_readable_facts, reversed(RunFolder(folder).checkpoints()))
    return next((facts for facts in found if facts is not None), None)


def _readable_facts(checkpoint: Path) -> CheckpointFacts | None:
    try:
        return load_facts(checkpoint)
    except RunError:  # the run itself says what is wrong
        return None


def _trained_differ(facts: CheckpointFacts, data: SceneData) -> str:
    """How the scene differs from what a run was trained on; empty if it does not."""
    if (facts.images, facts.temperature) == (data.facts.images, data.facts.temperature):
        return ""  # without reading all photos for every run
    return differences(facts, data.scene)


def _scores_differ(scores: Scores | None, data: SceneData) -> str:
    """How the scene differs from what scores say of theirs; empty if it does not, or they say
    nothing."""
    scored = ScoredData.from_json((scores or {}).get("data"))
    return "" if scored is None else scored.changes(data.scored, data.scene)
