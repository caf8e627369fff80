from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import pytest

from mrgs.runs.open import Run, load_run
from mrgs.scene import Camera, Scene
from mrgs.viewer.settings import Subject
from tests.helpers.runs import SMALL, trained_run
from tests.helpers.subjects import subject_of


@pytest.fixture(scope="session")
def small_run(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Both modalities, °C, one camera; trained for a moment, so that there is something to see."""
    output = tmp_path_factory.mktemp("runs") / "balls"
    return load_run(trained_run(tmp_path_factory, small_scene, SMALL, output))


@pytest.fixture(autouse=True)
def _without_marks(request: pytest.FixtureRequest) -> Iterator[None]:
    """The run is shared: no test leaves marks in it."""
    yield
    if "small_run" in request.fixturenames:
        for file in request.getfixturevalue("small_run").folder.path.iterdir():
            if file.name.startswith(("marks.", "survey.", "crop.")):
                file.unlink()


@pytest.fixture(scope="session")
def balls(small_run: Run) -> Scene:
    return small_run.load_scene()


@pytest.fixture
def subject(small_run: Run, balls: Scene, tmp_path: Path) -> Subject:
    return subject_of(small_run, balls, tmp_path)


@pytest.fixture
def camera() -> Camera:
    """Looks at the balls from x = 3, as wide as 4:3."""
    across_deg = math.degrees(2 * math.atan(math.tan(math.radians(22.5)) * 4 / 3))
    return Camera.from_fov(160, 120, across_deg).look_at((3.0, 0.0, 0.0), (0.0, 0.0, 0.0))
