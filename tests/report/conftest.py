"""The house front whose size and temperatures are known, and a small run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mrgs.runs.open import Run, load_run
from mrgs.scene import THERMAL
from mrgs.training import make_config, train
from tests.export.maps.conftest import front, front_scene

__all__ = ["front", "front_scene"]


@pytest.fixture(scope="module")
def trained(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "run"
    return train(small_scene, folder, make_config("mrgs", max_steps=60, max_gaussians=150)).path


@pytest.fixture
def run(trained: Path) -> Run:
    """The run, made solid (60 steps leave mist), without what a test before left in its folder."""
    for path in (*trained.glob("*marks*"), *trained.glob("survey.yaml")):
        path.unlink()
    for path in (trained / "eval").glob("*"):
        path.unlink()
    (trained / "eval").mkdir(exist_ok=True)
    run = load_run(trained)
    gaussians = run.model.gaussians
    solid = replace(
        gaussians,
        log_scales=torch.full_like(gaussians.log_scales, -1.2),
        opacity_logits=gaussians.opacity_logits
        | {THERMAL: torch.full_like(gaussians.opacity_logits[THERMAL], 4.0)},
    )
    return replace(run, model=replace(run.model, gaussians=solid))
