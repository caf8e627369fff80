from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.layouts import SceneWriter


@pytest.fixture
def writer(tmp_path: Path) -> SceneWriter:
    return SceneWriter(tmp_path / "scene")
