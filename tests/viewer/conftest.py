from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mrgs.runs.open import Run, load_run
from mrgs.scene import Camera, Scene
from mrgs.training import make_config, train
from mrgs.viewer.cameras import pinhole
from mrgs.viewer.settings import Subject
from mrgs.viewer.source import TrainedSource


@pytest.fixture(scope="session")
def small_run(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Both modalities, °C, one camera; trained for a moment, so that there is something to see."""
    config = make_config(max_steps=60, max_gaussians=300)
    return load_run(train(small_scene, tmp_path_factory.mktemp("runs") / "balls", config).path)


@pytest.fixture(scope="session")
def balls(small_run: Run) -> Scene:
    return small_run.load_scene()


@pytest.fixture
def make_subject(tmp_path: Path) -> Callable[..., Subject]:
    """A subject from a run; what it writes goes into the test's folder."""

    def make(run: Run, scene: Scene | None) -> Subject:
        return Subject("balls", TrainedSource(run.model), run.temperature, scene, tmp_path)

    return make


@pytest.fixture
def subject(make_subject: Callable[..., Subject], small_run: Run, balls: Scene) -> Subject:
    return make_subject(small_run, balls)


@pytest.fixture
def camera() -> Camera:
    """Looks at the balls from x = 3, as wide as 4:3."""
    forward, down = np.array([-1.0, 0, 0]), np.array([0, 0, -1.0])
    rotation = np.stack([np.cross(down, forward), down, forward], axis=1)
    from scipy.spatial.transform import Rotation

    wxyz = np.roll(Rotation.from_matrix(rotation).as_quat(), 1)
    return pinhole(wxyz, np.array([3.0, 0, 0]), math.radians(45), 160, 120)
