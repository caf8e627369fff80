from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from mrgs.errors import RunError
from mrgs.pictures.video import frame_writer

COLUMNS, ROWS = np.meshgrid(np.arange(65), np.arange(47))
FRAMES = [
    np.stack([2 * COLUMNS, 3 * ROWS, 0 * ROWS + 80 * index], axis=2).astype(np.uint8)
    for index in range(3)
]


def write(folder: Path, frames: Iterable[np.ndarray], mp4: bool | None = None) -> list[str]:
    """Names of all files that are there afterwards."""
    with frame_writer(folder, "path_rgb", (65, 47), mp4=mp4) as add:
        for frame in frames:
            add(frame)
    return sorted(
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()
    )


def test_frames_without_the_extra(tmp_path: Path) -> None:
    assert write(tmp_path, FRAMES, mp4=False) == [f"path_rgb/0000{index}.png" for index in range(3)]
    for index, frame in enumerate(FRAMES):
        with Image.open(tmp_path / "path_rgb" / f"0000{index}.png") as image:
            np.testing.assert_array_equal(np.asarray(image), frame)


def decode(path: Path, width: int, height: int) -> np.ndarray:
    """All frames of a video, [N, height, width, 3]."""
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-i",
        str(path),
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    run = subprocess.run(command, capture_output=True, check=True)
    assert f" {width}x{height}" in run.stderr.decode()
    assert " 24 fps" in run.stderr.decode()
    return np.frombuffer(run.stdout, np.uint8).reshape(-1, height, width, 3)


def test_an_mp4_with_even_sides_where_the_extra_is_installed(tmp_path: Path) -> None:
    assert "path_rgb.mp4" in write(tmp_path, FRAMES)
    found = decode(tmp_path / "path_rgb.mp4", 64, 46)
    expected = np.stack(FRAMES)[:, :46, :64]
    assert found.shape == expected.shape
    assert np.abs(found.astype(float) - expected).mean() < 3


def test_a_shorter_video_leaves_nothing_of_a_longer_one(tmp_path: Path) -> None:
    write(tmp_path, FRAMES)
    (tmp_path / "path_rgb" / "notes.txt").touch()
    assert write(tmp_path, FRAMES[:1], mp4=False) == ["path_rgb/00000.png", "path_rgb/notes.txt"]


def test_a_video_that_breaks_off_has_no_mp4(tmp_path: Path) -> None:
    def frames() -> Iterator[np.ndarray]:
        yield FRAMES[0]
        raise ValueError("the renderer failed")

    with pytest.raises(ValueError, match="the renderer failed"):
        write(tmp_path, frames())
    assert [path.name for path in tmp_path.iterdir()] == ["path_rgb"]


def test_an_old_frame_that_cannot_be_removed_is_named(tmp_path: Path) -> None:
    (tmp_path / "path_rgb" / "00007.png").mkdir(parents=True)
    with pytest.raises(
        RunError,
        match=r"00007\.png .*removed \(",
    ):
        write(tmp_path, FRAMES)


def test_an_encoder_that_fails_is_told_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", sys.executable)  # which does not know ffmpeg's options
    with pytest.raises(
        RunError,
        match=r"path_rgb\.mp4 .*written \(.+\): ",
    ) as told:
        write(tmp_path, 20 * FRAMES)
    assert "\n" not in str(told.value)
    assert not list(tmp_path.glob("*.mp4"))
