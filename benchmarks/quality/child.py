"""Trains once and scores the model at even shares of its steps: ``child.py REQUEST``.

Runs with any commit's ``mrgs`` on its path, so it uses only what all of them have: ``train`` and
``make_config``, ``open_run``, ``evaluate_run`` and the files of a run's folder.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def _now() -> tuple[float, float]:
    return time.process_time(), time.perf_counter()


class Clocks:
    """Processor and wall seconds, without the time between ``pause`` and ``go_on``."""

    def __init__(self, now: Callable[[], tuple[float, float]] = _now) -> None:
        self._now = now
        self._away = (0.0, 0.0)
        self._start = self._now()
        self._paused_at = self._start

    def read(self) -> tuple[float, float]:
        """Processor seconds, wall seconds."""
        cpu, wall = self._now()
        return cpu - self._start[0] - self._away[0], wall - self._start[1] - self._away[1]

    def pause(self) -> None:
        """Do not count what follows."""
        self._paused_at = self._now()

    def go_on(self) -> None:
        """Count again."""
        cpu, wall = self._now()
        self._away = (
            self._away[0] + cpu - self._paused_at[0],
            self._away[1] + wall - self._paused_at[1],
        )


def main() -> None:
    """Train, then score the copies that were taken on the way; prints one JSON line each."""
    request = json.loads(sys.argv[1])
    import torch

    from mrgs.training import from_yaml, make_config

    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    sizes = {name: request[name] for name in ("max_gaussians", "resolution", "max_steps")}
    config = make_config(request["method"], request["preset"], seed=request["seed"], **sizes)
    if request["change"]:
        config = from_yaml(request["change"], "change", config)
    stops = request["points"]
    every = max(1, config.max_steps // stops)
    folder = Path(request["folder"])
    for copy in _train(request["scene"], folder, config, every):
        print(json.dumps(copy | {"scores": _scores(folder / copy.pop("copy"))}), flush=True)


def _train(scene: str, folder: Path, config: Any, every: int) -> list[dict[str, Any]]:
    """Train, with a copy of the run after every so many steps."""
    from dataclasses import replace

    from mrgs import training
    from mrgs.training import train

    config = replace(config, checkpoint_every=every)
    copies: list[dict[str, Any]] = []
    clocks = Clocks()
    due: list[dict[str, Any]] = []

    def copied(entry: dict[str, Any]) -> None:
        clocks.pause()
        name = f"step_{entry['step']}"
        shutil.copytree(folder / "run", folder / name)
        copies.append(entry | {"copy": name})
        clocks.go_on()

    def on_step(statistics: Any) -> None:
        # The checkpoint of a step is written after its call: it is there at the next one.
        if due:
            copied(due.pop())
        if statistics.step % every == 0 and statistics.step < config.max_steps:
            due.append(_entry(statistics, clocks))
        last.update(_entry(statistics, clocks))

    last: dict[str, Any] = {}
    if hasattr(training, "Hooks"):
        train(scene, folder / "run", config, hooks=training.Hooks(on_step))
    else:  # earlier commits
        train(scene, folder / "run", config, on_step=on_step)  # type: ignore[call-arg]
    cpu, wall = clocks.read()
    copied(last | {"cpu_s": cpu, "wall_s": wall})
    return copies


def _entry(statistics: Any, clocks: Clocks) -> dict[str, Any]:
    cpu, wall = clocks.read()
    return {
        "step": statistics.step,
        "cpu_s": cpu,
        "wall_s": wall,
        "gaussians": statistics.gaussians,
    }


def _scores(folder: Path) -> dict[str, float]:
    """Of a run, which is removed."""
    from mrgs import open_run
    from mrgs.evaluation import evaluate_run

    evaluate_run(open_run(folder))
    metrics = json.loads((folder / "eval" / "metrics.json").read_text(encoding="utf-8"))
    shutil.rmtree(folder)
    return scores_of(metrics)


def scores_of(metrics: dict[str, Any]) -> dict[str, float]:
    """The three scores of a run's metrics.json that are followed."""
    mean, truth = metrics["mean"], metrics.get("truth") or {}
    scores = {modality: mean.get(modality, {}).get("psnr") for modality in ("thermal", "rgb")}
    if truth.get("mae_c") and truth.get("camera_mae_c"):
        scores["error"] = truth["mae_c"] / truth["camera_mae_c"]
    return {name: float(value) for name, value in scores.items() if value is not None}


if __name__ == "__main__":
    main()
