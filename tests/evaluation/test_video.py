from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

from mrgs.evaluation import video


class Recorder:
    """Takes the place of imageio's writer."""

    def __init__(self, path: Path) -> None:
        self.path, self.frames = path, []

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.path.write_bytes(b"mp4")

    def append_data(self, frame: np.ndarray) -> None:
        self.frames.append(frame)


FRAMES = [np.full((7, 9, 3), 40 * index, np.uint8) for index in range(3)]


def test_frames_without_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "can_write_mp4", lambda: False)
    paths = video.write_frames(tmp_path, "path_rgb", iter(FRAMES))
    assert [path.relative_to(tmp_path).as_posix() for path in paths] == [f"path_rgb/0000{i}.png" for i in range(3)]
    for path, frame in zip(paths, FRAMES, strict=True):
        with Image.open(path) as image:
            np.testing.assert_array_equal(np.asarray(image), frame)
    assert not (tmp_path / "path_rgb.mp4").exists()


def test_an_mp4_with_even_sides_where_the_extra_is_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorders: list[Recorder] = []

    def get_writer(path: Path, **options: object) -> Recorder:
        assert options["fps"] == 12
        recorders.append(Recorder(path))
        return recorders[0]

    module = ModuleType("imageio.v2")
    module.get_writer = get_writer
    monkeypatch.setattr(video, "can_write_mp4", lambda: True)
    monkeypatch.setitem(sys.modules, "imageio", ModuleType("imageio"))
    monkeypatch.setattr(sys.modules["imageio"], "v2", module, raising=False)
    monkeypatch.setitem(sys.modules, "imageio.v2", module)
    paths = video.write_frames(tmp_path, "path_rgb", FRAMES, fps=12)
    assert paths[-1] == tmp_path / "path_rgb.mp4"
    assert paths[-1].read_bytes() == b"mp4"
    assert [frame.shape for frame in recorders[0].frames] == [(6, 8, 3)] * 3
