"""Runs to damage: each test gets a copy of its own."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from mrgs.run_files.folder import RunFolder
from mrgs.training import train
from mrgs_thermonerf import train_thermonerf
from tests.faults.runs import GAUSSIANS, NERF
from tests.helpers.runs import made_once
from tests.helpers.threads import one_torch_thread

__all__ = ["one_torch_thread"]


@pytest.fixture(scope="session")
def gaussians_base(tmp_path_factory: pytest.TempPathFactory, small_scene: Path) -> Path:
    """Ten steps of Gaussians with checkpoints of steps 5 and 10; only to be read."""
    return made_once(
        tmp_path_factory, "faults_gaussians", lambda path: train(small_scene, path, GAUSSIANS)
    )


@pytest.fixture(scope="session")
def nerf_base(tmp_path_factory: pytest.TempPathFactory, small_scene: Path) -> Path:
    """Ten steps of a radiance field with checkpoints of steps 5 and 10; only to be read."""
    return made_once(
        tmp_path_factory, "faults_nerf", lambda path: train_thermonerf(small_scene, path, NERF)
    )


@pytest.fixture
def gaussians_run(gaussians_base: Path, tmp_path: Path) -> RunFolder:
    """A copy of the run of Gaussians."""
    return RunFolder(shutil.copytree(gaussians_base, tmp_path / "gaussians"))


@pytest.fixture
def nerf_run(nerf_base: Path, tmp_path: Path) -> RunFolder:
    """A copy of the run of a radiance field."""
    return RunFolder(shutil.copytree(nerf_base, tmp_path / "nerf"))
