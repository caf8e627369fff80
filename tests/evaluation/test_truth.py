from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.data.images import read_float_tiff
from mrgs.errors import SceneError
from mrgs.evaluation.evaluate import Truth
from mrgs.evaluation.metrics import Figures, Missing
from mrgs.pictures.files import write_float_tiff
from mrgs.scene import Pixels, TemperatureRange

RANGE = TemperatureRange(0.0, 100.0)


def write(scene: Path, kind: str, values: np.ndarray, name: str = "v") -> Path:
    return write_float_tiff(
        scene / "truth" / kind / f"{name}.tiff", values.astype(np.float32), kind
    )


def score(
    scene: Path,
    thermal: torch.Tensor,
    depth: torch.Tensor | None,
    valid: torch.Tensor | None = None,
) -> Figures:
    return Truth(scene / "truth").score(
        "v", thermal[..., None] / 100, Pixels(thermal[..., None] / 100, valid), depth, RANGE
    )


def test_a_scene_without_truth(tmp_path: Path) -> None:
    assert Truth.of(SimpleNamespace(path=str(tmp_path))) is None


def test_the_sky_has_no_depth(tmp_path: Path) -> None:
    write(tmp_path, "depth", np.array([[2.0, 4.0, np.inf, 0.0, 0.0, -1.0, np.nan, 10.0]]))
    figures = score(
        tmp_path, torch.zeros(1, 8), torch.tensor([[2.2, 6.0, 1.0, 1.0, 1.0, 1.0, 1.0, 10.0]])
    )
    assert figures["depth_median_relative_error"] == pytest.approx(0.1, abs=1e-6)
    assert "truth/temperature/v.tiff" in figures["mae_c"].reason


def test_only_sky_is_missing(tmp_path: Path) -> None:
    write(tmp_path, "depth", np.full((2, 2), np.inf))
    figures = score(tmp_path, torch.zeros(2, 2), torch.ones(2, 2))
    assert "truth/depth/v.tiff" in figures["depth_median_relative_error"].reason


def test_without_temperature_scale_or_depth(tmp_path: Path) -> None:
    write(tmp_path, "temperature", np.zeros((2, 2)))
    truth = Truth(tmp_path / "truth")
    figures = truth.score("v", torch.zeros(2, 2, 1), None, None, None)
    assert all(isinstance(figure, Missing) for figure in figures.values())


def test_a_smaller_rendering_sees_area_means(tmp_path: Path) -> None:
    exact = np.arange(24.0).reshape(4, 6)
    write(tmp_path, "temperature", exact)
    small = torch.from_numpy(exact.reshape(2, 2, 3, 2).mean(axis=(1, 3))).float()
    figures = score(tmp_path, small + 3, None)
    assert figures["mae_c"] == pytest.approx(3.0, abs=1e-4)


@pytest.mark.parametrize("shape", [(8, 12), (4, 2)])
def test_another_shape_is_missing_not_stretched(tmp_path: Path, shape: tuple[int, int]) -> None:
    write(tmp_path, "temperature", np.zeros((4, 6)))
    figure = score(tmp_path, torch.zeros(shape), None)["mae_c"]
    assert isinstance(figure, Missing)
    assert re.search(rf"6×4\b.*\b{shape[1]}×{shape[0]}$", figure.reason)


def test_the_cameras_error_counts_valid_pixels_only(tmp_path: Path) -> None:
    write(tmp_path, "temperature", np.zeros((1, 4)))
    valid = torch.tensor([[True, True, False, False]])
    figures = score(tmp_path, torch.tensor([[1.0, 3.0, 90.0, 90.0]]), None, valid)
    assert figures["camera_mae_c"] == pytest.approx(2.0, abs=1e-5)


def test_a_name_that_leaves_the_scene(tmp_path: Path) -> None:
    (tmp_path / "truth").mkdir()
    write(tmp_path, "elsewhere", np.zeros((2, 2)))
    with pytest.raises(SceneError, match="lies outside"):
        Truth(tmp_path / "truth").score("../../../v", torch.zeros(2, 2, 1), None, None, RANGE)


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "v.tiff"
    path.write_bytes(b"II*\0 not a tiff")
    with pytest.raises(SceneError, match=r"v\.tiff: .*decoded"):
        read_float_tiff(path)


def test_a_truncated_file_is_named(tmp_path: Path) -> None:
    path = write(tmp_path, "depth", np.ones((40, 40)))
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(SceneError, match=r"v\.tiff: .*decoded"):
        read_float_tiff(path)


def test_a_damaged_byte_of_the_tags_is_read_or_named(tmp_path: Path) -> None:
    path = write(tmp_path, "depth", np.ones((8, 8)))
    content = path.read_bytes()
    for place in range(len(content)):
        path.write_bytes(content[:place] + b"\2" + content[place + 1 :])
        with suppress(SceneError):  # Pillow raises TypeError for some
            read_float_tiff(path)


def test_another_format_with_float_pixels_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "v.tiff"
    Image.fromarray(np.ones((4, 4), np.float32)).save(path, format="PPM")  # a PFM file
    with pytest.raises(SceneError, match=r"v\.tiff: .*decoded"):
        read_float_tiff(path)


def test_a_file_of_another_kind_is_named(tmp_path: Path) -> None:
    path = tmp_path / "v.tiff"
    Image.new("L", (4, 4)).save(path)
    with pytest.raises(SceneError, match=r"float32 .*mode L"):
        read_float_tiff(path)
