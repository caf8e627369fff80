"""One run of a comparison: training and scoring, and what its folder has already."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias, cast

from mrgs.errors import ConfigError, RunError
from mrgs.evaluation import evaluate_run
from mrgs.evaluation.metrics import REPORTED, figure_names
from mrgs.evaluation.report import ScoredData
from mrgs.run_files.checkpoint import load_facts
from mrgs.run_files.facts import CheckpointFacts, differences
from mrgs.run_files.folder import RunConfig, RunFolder
from mrgs.runs.open import method_of, open_run
from mrgs.runs.registry import find_method
from mrgs.scene import Scene
from mrgs.system.disk import read_text
from mrgs.system.gpu import DeviceName
from mrgs.system.strict_yaml import first_difference, flat
from mrgs.training.start import Hooks, TrainOptions

OnStep: TypeAlias = Callable[[Any], bool | None]
"""Called with a step's statistics (``step``, ``gaussians``); returning True stops the training."""

Scores: TypeAlias = dict[str, Any]
"""The content of a ``metrics.json``."""


def run_one(
    scene: Path,
    folder: Path,
    config: RunConfig,
    *,
    device: DeviceName = "auto",
    lpips_weights: Path | None = None,
    on_step: OnStep | None = None,
    on_score: Callable[[int, int], None] | None = None,
) -> bool:
    """Train, continue, or only score one run, depending on its state, on a GPU if the method can;
    returns whether it is scored. ``on_step``, called after every training step, stops it, with a
    checkpoint, by returning True; ``on_score`` is called with the numbers of scored views and of
    all. MrgsError if the scene or the folder cannot be used, or the training had to stop."""
    method = find_method(config.method)
    device = device if method.uses_gpu else "cpu"
    if not _is_trained(folder, config):
        resume = bool(RunFolder(folder).checkpoints())
        method.train(scene, folder, config, TrainOptions(resume, device=device), Hooks(on_step))
    run = open_run(folder, scene, device)
    if run.facts.step < config.max_steps:
        return False
    evaluate_run(run, lpips_weights, on_score)
    return True


def is_scored(scores: Scores | None, folder: Path, config: RunConfig, with_lpips: bool) -> bool:
    """Whether scores are of the finished run, with LPIPS if required. Scores of an older version,
    which lack a figure, do not count if the run can be scored again."""
    if scores is None or scores.get("steps") != config.max_steps:
        return False
    names = {modality.name: set(figure_names(modality)) for modality in REPORTED}
    is_complete = all(_means(scores, name).keys() >= own for name, own in names.items())
    if not is_complete and _is_trained(folder, config):
        return False
    return not with_lpips or any(
        _means(scores, group).get("lpips") is not None for group in scores.get("mean") or {}
    )


def run_scores(folder: Path) -> Scores | None:
    """The scores in a run's folder; None if there are none, or unreadable ones."""
    return read_metrics(folder / "eval")


def read_metrics(folder: Path) -> Scores | None:
    """The content of a folder's ``metrics.json``; None if it is missing or unreadable."""
    try:
        document = json.loads(read_text(folder / "metrics.json"))
    except (OSError, ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None


def require_same_config(folder: Path, config: RunConfig, scores: Scores | None) -> None:
    """Check that the run or the scores in a folder have this configuration. ConfigError if it was
    trained with another, whose message names the first value that differs; RunError if its
    configuration cannot be read."""
    run = RunFolder(folder)
    if not run.config_file.exists() or not (run.checkpoints() or scores):
        return
    found = run.read_config(method_of(run).read_config)
    there, here = (flat(dataclasses.asdict(cast(Any, each))) for each in (found, config))
    if (name := first_difference(here, there)) is not None:
        raise ConfigError(
            f"{folder} holds a run with another configuration ({name} is {there.get(name)} "
            f"there and {here.get(name)} here): choose another folder, or remove this one",
            options=("output",),
        )


def _is_trained(folder: Path, config: RunConfig) -> bool:
    """Whether the newest checkpoint, by its name, is that of the last step."""
    return config.max_steps in (
        int(path.stem.removeprefix("step_")) for path in RunFolder(folder).checkpoints()
    )


def _means(scores: Scores, group: str) -> dict[str, Any]:
    """A group's means; empty if the scores have another shape."""
    means = scores.get("mean")
    figures = means.get(group) if isinstance(means, dict) else None
    return figures if isinstance(figures, dict) else {}


class SceneData:
    """The present data of a scene; its photos are read once, when a run is compared with it."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    @cached_property
    def facts(self) -> CheckpointFacts:
        """The facts of a run that began now."""
        return CheckpointFacts.at_start(self.scene)

    @cached_property
    def _scored(self) -> ScoredData:
        """The data of scores that were computed now."""
        return ScoredData.of(self.scene, self.facts.images)

    def changed_since(self, scores: Scores | None) -> str:
        """How the scene differs from the data of scores; empty if it does not, or they name none.
        SceneError if a photo cannot be read."""
        scored = ScoredData.from_json((scores or {}).get("data"))
        return "" if scored is None else scored.changes(self._scored, self.scene)


def require_same_data(folder: Path, data: SceneData, scores: Scores | None) -> None:
    """Check that a run was trained on the present data of its scene; held-out images may differ if
    there is a checkpoint to score again. ConfigError if it was trained, or scored, on other data,
    which says what has changed; SceneError if a photo cannot be read."""
    facts = None  # of the newest readable checkpoint; the run itself reports others
    for checkpoint in RunFolder(folder).checkpoints():
        with suppress(RunError):
            facts = load_facts(checkpoint)
    if facts is None:
        changed = data.changed_since(scores)
    elif (facts.images, facts.temperature) == (data.facts.images, data.facts.temperature):
        return  # without reading all photos for every run
    else:
        changed = differences(facts, data.scene)
    if changed:
        raise ConfigError(
            f"{folder} holds a run of other data than {data.scene.name} has now ({changed}): "
            f"choose another folder, or remove this one",
            options=("output",),
        )
