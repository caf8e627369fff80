"""One run, from photos to scores."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias, cast

from mrgs.comparison.methods import OnStep, device_of, read_config, train_run
from mrgs.errors import ConfigError
from mrgs.evaluation import evaluate_run
from mrgs.evaluation.figures import REPORTED, figure_names
from mrgs.runs.open import open_run
from mrgs.system.gpu import DeviceName
from mrgs.system.strict_yaml import first_difference, flat
from mrgs.training.run_folder import RunConfig, RunFolder


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
    """Train, continue, or only score one run, depending on its state.

    Args:
        scene: the scene's folder.
        folder: the run's folder.
        config: what the run is trained with.
        device: where it is trained and rendered, if its method can use a GPU.
        lpips_weights: weights for LPIPS, see ``evaluate_run``.
        on_step: called after every training step; returning True stops with a checkpoint.
        on_score: called after each scored view with their number and that of all.

    Returns:
        whether the run is scored; False if ``on_step`` stopped it.

    Raises:
        MrgsError: the scene or the folder cannot be used, or the training had to stop.
    """
    if not _is_trained(folder, config):
        train_run(scene, folder, config, on_step, device)
    run = open_run(folder, scene, device_of(config, device))
    if run.facts.step < config.max_steps:
        return False
    evaluate_run(run, lpips_weights, on_score)
    return True


Scores: TypeAlias = dict[str, Any]
"""The content of a ``metrics.json``."""


def is_scored(scores: Scores | None, folder: Path, config: RunConfig, with_lpips: bool) -> bool:
    """Whether the scores in a run's folder are those of the finished run, with LPIPS if they must
    have it.

    Scores of an older version, which lack a figure, do not count if the run can be scored again as
    it is.
    """
    if scores is None or scores.get("steps") != config.max_steps:
        return False
    if not _has_every_figure(scores) and _is_trained(folder, config):
        return False
    return not with_lpips or _has_lpips(scores)


def run_scores(folder: Path) -> Scores | None:
    """The scores in a run's folder; None where there are none that can be read."""
    return read_metrics(folder / "eval")


def read_metrics(folder: Path) -> Scores | None:
    """The content of a folder's ``metrics.json``; None where there is none that can be read."""
    try:
        document = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None


def require_same_config(folder: Path, config: RunConfig, scores: Scores | None) -> None:
    """A folder that holds a run, or its scores, holds one of this configuration.

    Raises:
        ConfigError: it was trained with another; the message names the first value that differs.
        RunError: its configuration cannot be read.
    """
    run = RunFolder(folder)
    if not run.config_file.exists() or not (run.checkpoints() or scores):
        return
    there, here = (flat(dataclasses.asdict(cast(Any, each))) for each in (read_config(run), config))
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


def _has_every_figure(document: dict[str, Any]) -> bool:
    """Whether each figure is there, be it as null."""
    return all(
        _means(document, modality.name).keys() >= set(figure_names(modality))
        for modality in REPORTED
    )


def _has_lpips(document: dict[str, Any]) -> bool:
    means = document.get("mean")
    groups = means if isinstance(means, dict) else {}
    return any(_means(document, group).get("lpips") is not None for group in groups)


def _means(document: dict[str, Any], group: str) -> dict[str, Any]:
    """A group's means; empty where the document has another shape."""
    means = document.get("mean")
    figures = means.get(group) if isinstance(means, dict) else None
    return figures if isinstance(figures, dict) else {}
