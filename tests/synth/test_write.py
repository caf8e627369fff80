from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mrgs.errors import ConfigError
from mrgs.scene import TemperatureRange
from mrgs_synth.stage import Stage
from mrgs_synth.write import SceneFolder, write_float_tiff


def test_transforms_follow_nerfstudio(tmp_path: Path, two_boxes: Stage) -> None:
    cameras = two_boxes.cameras.train(2, 32, 24, np.random.default_rng(0))
    SceneFolder.create(tmp_path).transforms(
        {"frame_train_00001": cameras[0], "frame_eval_00001": cameras[1]}
    )
    written = json.loads((tmp_path / "transforms.json").read_text())
    assert (written["w"], written["h"], written["cx"], written["cy"]) == (32, 24, 16.0, 12.0)
    assert written["camera_model"] == "OPENCV"
    assert written["fl_x"] == written["fl_y"] == cameras[0].K[0, 0].item()
    assert written["ply_file_path"] == "sparse_pc.ply"
    assert [frame["file_path"] for frame in written["frames"]] == [
        "images/frame_train_00001.jpg",
        "images/frame_eval_00001.jpg",
    ]
    assert written["frames"][1]["thermal_file_path"] == "thermal/frame_eval_00001.png"
    pose = np.array(written["frames"][0]["transform_matrix"])
    np.testing.assert_allclose(pose[:3, 3], cameras[0].position.numpy())
    np.testing.assert_allclose(-pose[:3, 2], cameras[0].forward.numpy())  # OpenGL looks along −z
    assert pose[2, 1] > 0  # and its y points up


def test_truth_survives_to_within_half_a_step(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    celsius, depth = rng.uniform(-5.0, 80.0, (24, 32)), rng.uniform(0.5, 4.0, (24, 32))
    SceneFolder.create(tmp_path).truth("frame_eval_00001", celsius, depth)
    for kind, exact, step in (("temperature", celsius, 2.0**-9), ("depth", depth, 2.0**-14)):
        with Image.open(tmp_path / f"truth/{kind}/frame_eval_00001.tiff") as image:
            assert image.mode == "F"
            values = np.asarray(image)
        assert values.dtype == np.float32
        assert np.abs(values - exact).max() <= step / 2 * 1.001


def test_smooth_truth_is_compressed(tmp_path: Path) -> None:
    smooth = np.linspace(20.0, 30.0, 64)[:, None] + np.linspace(0.0, 5.0, 64)
    write_float_tiff(tmp_path / "smooth.tiff", smooth, 2.0**-9)
    assert (tmp_path / "smooth.tiff").stat().st_size < 0.6 * smooth.size * 4


def test_images_bounds_and_points(tmp_path: Path) -> None:
    folder = SceneFolder.create(tmp_path)
    grey = np.random.default_rng(0).integers(0, 256, (24, 32), dtype=np.uint8)
    folder.thermal("frame_train_00001", grey)
    folder.rgb("frame_train_00001", np.repeat(np.full_like(grey, 90)[..., None], 3, axis=2))
    folder.temperature_bounds(TemperatureRange(-1.0, 83.0))
    folder.points(
        np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]),
        np.array([[1, 2, 3], [4, 5, 6]], dtype=np.uint8),
    )
    with Image.open(tmp_path / "thermal/frame_train_00001.png") as image:
        assert image.mode == "L"
        np.testing.assert_array_equal(np.asarray(image), grey)
    with Image.open(tmp_path / "images/frame_train_00001.jpg") as image:
        assert image.size == (32, 24)
        assert np.abs(np.asarray(image).astype(int) - 90).max() <= 1
    bounds = json.loads((tmp_path / "temperature_bounds.json").read_text())
    assert bounds == {"absolute_max_temperature": 83.0, "absolute_min_temperature": -1.0}
    header, body = (tmp_path / "sparse_pc.ply").read_bytes().split(b"end_header\n")
    assert b"format binary_little_endian 1.0" in header
    assert b"element vertex 2" in header
    rows = np.frombuffer(body, dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    assert rows["xyz"].tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert rows["rgb"].tolist() == [[1, 2, 3], [4, 5, 6]]


def test_a_scene_is_never_overwritten(tmp_path: Path) -> None:
    folder = SceneFolder.create(tmp_path / "scene")
    SceneFolder.create(tmp_path / "scene")  # what an interrupted run left behind is empty
    folder.rgb("frame_train_00001", np.zeros((24, 32, 3), dtype=np.uint8))
    with pytest.raises(ConfigError, match="already"):
        SceneFolder.create(tmp_path / "scene")


def test_output_must_be_a_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        SceneFolder.create(tmp_path / "file")
