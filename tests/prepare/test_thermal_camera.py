from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.errors import ConfigError, SceneError
from mrgs.prepare import PrepareOptions
from mrgs.prepare.contract import ConvertedPhotos, Georeference, Reconstruction
from mrgs.prepare.thermal_camera import calibrate_thermal_camera, read_thermal_camera
from mrgs.prepare.work import Work
from mrgs.scene import RGB, THERMAL, Modality, PointCloud
from mrgs.scene.lens import Lens
from tests.helpers.converted import converted_view

LENS = {
    "camera_model": "OPENCV",
    "w": 32,
    "h": 24,
    "fl_x": 40.0,
    "cx": 16.0,
    "cy": 12.0,
    "k1": -0.3,
    "k2": 0.1,
}
MOTION = [[0.0, -1.0, 0.0, 0.03], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]

IDENTITY = Georeference(
    1.0, torch.eye(3).double(), torch.zeros(3).double(), True, False, None, None, ""
)


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Writes a camera file of these keys."""

    def written(**content: object) -> Path:
        (tmp_path / "camera.json").write_text(json.dumps(content))
        return tmp_path / "camera.json"

    return written


@pytest.fixture
def asked() -> list:
    """The arguments of each call of the calibration, which is not done."""
    return []


@pytest.fixture
def calibrate(tmp_path: Path, asked: list) -> Callable[..., object]:
    """Calls the stage on two views, one of them without a pose."""
    for folder, size in (("images", (40, 30)), ("thermal", (32, 24))):
        (tmp_path / folder).mkdir()
        for name in "ab":
            Image.fromarray(np.full(size[::-1], 100, np.uint8)).save(
                tmp_path / folder / f"{name}.png"
            )
    found = Reconstruction(
        {"b": torch.eye(4, dtype=torch.float64)},
        {"b": Lens(40, 30, 40.0, 40.0, 20.0, 15.0)},
        PointCloud(torch.zeros(3, 3), torch.zeros(3, 3)),
        {"b": torch.arange(2)},
        (),
        None,
        "test",
    )

    def called(
        metric: bool = True,
        images: Modality = RGB,
        thermal_size: tuple[int, int] = (32, 24),
        **options: object,
    ) -> object:
        views = tuple(
            converted_view(
                name,
                {RGB: f"images/{name}.png", THERMAL: f"thermal/{name}.png"},
                sizes={RGB: (40, 30), THERMAL: thermal_size},
            )
            for name in "ab"
        )
        work = Work(tmp_path, tmp_path, PrepareOptions(**options))
        work.images, work.poses = ConvertedPhotos(views, ()), replace(found, images=images)
        work.georeference = replace(IDENTITY, metric=metric)
        file = work.options.thermal_camera
        given = None if file is None else read_thermal_camera(file)
        return calibrate_thermal_camera(work, lambda *arguments: asked.append(arguments), given)

    return called


def test_views_with_poses_are_calibrated(calibrate, asked):
    calibrate(thermal_fov_deg=50.0)
    ((pairs, points, options, _),) = asked
    assert [(pair.name, pair.visible.tolist()) for pair in pairs] == [("b", [0, 1])]
    assert pairs[0].photo.load().values.shape == (30, 40, 3)
    assert pairs[0].load_thermal().values.shape == (24, 32, 1)
    assert len(points.positions) == 3
    assert (options.field_of_view_deg, options.thermal_lens, options.extrinsics) == (
        50.0,
        None,
        None,
    )


def test_one_camera_needs_no_calibration(calibrate, asked):
    assert calibrate(one_camera=True) is None
    assert asked == []


def test_one_camera_has_images_of_one_shape(calibrate):
    with pytest.raises(SceneError, match=r"b: .*40×30 .*32×20"):
        calibrate(thermal_size=(32, 20), one_camera=True)


def test_one_camera_of_which_one_image_lies_on_its_side(calibrate):
    with pytest.raises(SceneError, match=r"b: .*30×40.*EXIF orientation"):
        calibrate(thermal_size=(30, 40), one_camera=True)


def test_thermal_images_alone_have_no_second_camera(calibrate, asked):
    assert calibrate(images=THERMAL) is None
    assert calibrate(images=THERMAL, thermal_fov_deg=40.0) is None  # structure from motion took it
    with pytest.raises(ConfigError, match="only thermal images") as error:
        calibrate(images=THERMAL, one_camera=True)
    with pytest.raises(ConfigError, match="only thermal images"):
        calibrate(images=THERMAL, thermal_fov_deg=40.0, poses=Path("poses"))
    assert error.value.options == ("one_camera",)
    assert asked == []


def test_a_file_is_taken_as_it_is(calibrate, asked, write):
    calibrate(thermal_camera=write(thermal_camera=LENS, thermal_from_rgb_m=MOTION))
    options = asked[0][2]
    assert options.thermal_lens == Lens(32, 24, 40.0, 40.0, 16.0, 12.0, (-0.3, 0.1, 0.0, 0.0))
    assert options.extrinsics.tolist() == MOTION


def test_without_metres_the_lens_alone_is_taken(calibrate, asked, write):
    calibrate(False, thermal_camera=write(thermal_camera=LENS, thermal_from_rgb_m=MOTION))
    assert asked[0][2].thermal_lens is not None
    assert asked[0][2].extrinsics is None
    with pytest.raises(SceneError, match="known distance"):
        calibrate(False, thermal_camera=write(thermal_from_rgb_m=MOTION))


def test_a_camera_of_other_images_is_told(calibrate, asked, write):
    file = write(thermal_camera={**LENS, "w": 64, "h": 48})
    with pytest.raises(SceneError, match=r"64×48 .*b\.png .*32×24"):
        calibrate(thermal_camera=file)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"frames": []}, "neither thermal_camera nor thermal_from_rgb_m"),
        ({"thermal_camera": 5}, "thermal_camera is 5"),
        (
            {"thermal_camera": {**LENS, "fl_x": None}},
            "thermal_camera .*fl_x",
        ),
        ({"thermal_camera": {**LENS, "fl_x": -4}}, "focal length .* -4"),
        ({"thermal_camera": {**LENS, "w": None}}, "w of thermal_camera"),
        (
            {"thermal_camera": {**LENS, "p1": 0.01}},
            "k1 and k2",
        ),
        (
            {"thermal_camera": {**LENS, "camera_model": "OPENCV_FISHEYE"}},
            "k1 and k2",
        ),
        (
            {"thermal_from_rgb_m": [[1, 0], [0, 1]]},
            "thermal_from_rgb_m is .*3×4",
        ),
        (
            {"thermal_from_rgb_m": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]},
            "rotation and a translation",
        ),
    ],
)
def test_a_bad_file_is_named(content, message, write):
    with pytest.raises(SceneError, match=rf"camera\.json: .*{message}"):
        read_thermal_camera(write(**content))
