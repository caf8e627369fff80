"""What ``write_scene`` writes is what ``load_scene`` reads."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.data import load_scene
from mrgs.data.radiometric import GpsPosition, ObjectParameters, Overrides, PhotoFacts
from mrgs.errors import RunError, SceneError
from mrgs.prepare import PrepareOptions
from mrgs.prepare.contract import ConvertedPhotos, Georeference, Reconstruction
from mrgs.prepare.rig.contract import RigCalibration, RigView
from mrgs.prepare.scene_files import write_scene
from mrgs.prepare.work import Work
from mrgs.scene import RGB, THERMAL, Camera, PointCloud
from mrgs.scene.lens import Lens, pinhole_of
from mrgs.scene.radiometry import Planck
from tests.helpers.converted import converted_view

RGB_LENS = Lens(32, 24, 30.0, 31.0, 15.0, 12.5, (-0.05, 0.01, 0.002, 0.0), (0.001, -0.002))
OTHER_RGB = Lens(32, 24, 28.0, 28.0, 16.0, 12.0)
FISHEYE = Lens(32, 24, 20.0, 20.0, 16.0, 12.0, (0.01, 0.002, 0.001, 0.0005), fisheye=True)
THERMAL_LENS = Lens(16, 12, 14.0, 14.2, 8.0, 6.0, (-0.1, 0.0, 0.0, 0.0))
OFFSET = torch.tensor(
    [[1.0, 0, 0, 0.05], [0, 1, 0, -0.01], [0, 0, 1, 0.002], [0, 0, 0, 1]], dtype=torch.float64
)
METRIC = Georeference(
    1.0,
    torch.eye(3).double(),
    torch.zeros(3).double(),
    True,
    True,
    GpsPosition(48.1, 11.5, 520.0),
    0.8,
    "By GPS.",
)


def viewmat(index: int) -> torch.Tensor:
    turn, matrix = 0.2 * index, torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.tensor(
        [[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]],
        dtype=torch.float64,
    )
    matrix[:3, 3] = torch.tensor([0.1 * index, -0.3, 2.0])
    return matrix


def convert(
    scene: Path, count: int, celsius: bool = True, thermal_size: tuple[int, int] = (16, 12)
) -> ConvertedPhotos:
    """Images of a set whose temperatures are 10.4 + i to 20.2 + i °C."""
    views = []
    for folder in ("images", "thermal"):
        (scene / folder).mkdir(parents=True)
    for i in range(count):
        name = f"shot_{i}"
        Image.fromarray(np.full((24, 32, 3), 9 * i, dtype=np.uint8)).save(
            scene / "images" / f"{name}.png"
        )
        ramp = np.linspace(0, 1, thermal_size[0] * thermal_size[1], dtype=np.float32).reshape(
            thermal_size[::-1]
        )
        thermal = f"thermal/{name}.{'tiff' if celsius else 'png'}"
        Image.fromarray(10.4 + i + 9.8 * ramp if celsius else (255 * ramp).astype(np.uint8)).save(
            scene / thermal
        )
        range_c = (10.4 + i, 20.2 + i) if celsius else None
        views.append(
            converted_view(
                name,
                {RGB: f"images/{name}.png", THERMAL: thermal},
                sizes={THERMAL: thermal_size},
                range_c=range_c,
            )
        )
    return ConvertedPhotos(tuple(views), ())


def reconstruct(names: list[str], lens: Lens = RGB_LENS) -> Reconstruction:
    points = PointCloud(
        torch.tensor([[0.0, 1, 2], [0.5, -0.25, 4]]), torch.tensor([[0.0, 0.2, 1], [1, 0.4, 0]])
    )
    viewmats = {name: viewmat(int(name.rpartition("_")[2])) for name in names}
    return Reconstruction(viewmats, dict.fromkeys(names, lens), points, None, (), 0.5, "by hand")


def rig_of(names: list[str]) -> RigCalibration:
    """A rig of which each pair has a small motion of its own."""
    views = []
    for i, name in enumerate(names):
        correction = torch.eye(4, dtype=torch.float64)
        correction[0, 3] = 0.001 * i
        views.append(RigView(name, correction, 50, 0.5, 0.3))
    return RigCalibration(THERMAL_LENS, OFFSET, tuple(views), (0.5, 1.0), 0.3, 0.2, ())


def write(
    scene: Path, images, poses, rig, georeference, *, eval_every: int = 8, bounds=None
) -> None:
    options = PrepareOptions(overrides=Overrides(bounds_c=bounds), eval_every=eval_every)
    work = Work(scene, scene, options, images=images, poses=poses, rig=rig)
    work.georeference = georeference
    write_scene(work)


def assert_camera(camera: Camera, lens: Lens, expected_viewmat: torch.Tensor) -> None:
    pinhole = pinhole_of(lens)
    assert (camera.width, camera.height) == (lens.width, lens.height)
    torch.testing.assert_close(camera.viewmat, expected_viewmat, atol=1e-12, rtol=0)
    numbers = torch.tensor([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy], dtype=torch.float64)
    torch.testing.assert_close(camera.K[[0, 1, 0, 1], [0, 1, 2, 2]], numbers)


def test_cameras_points_split_and_bounds_come_back(tmp_path):
    photos = convert(tmp_path, 10)
    names = [view.name for view in photos.views if view.name != "shot_3"]
    rig = rig_of(names)
    write(tmp_path, photos, reconstruct(names), rig, METRIC, eval_every=4, bounds=None)
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.eval] == ["shot_0", "shot_5", "shot_9"]
    views = {view.name: view for view in scene.views}
    assert set(views) == set(names)
    for name in names:
        own = viewmat(int(name.rpartition("_")[2]))
        assert_camera(views[name].images[RGB].camera, RGB_LENS, own)
        assert_camera(views[name].images[THERMAL].camera, THERMAL_LENS, rig.viewmat(name, own))
    torch.testing.assert_close(scene.points.positions, reconstruct(names).points.positions)
    torch.testing.assert_close(
        scene.points.colors, reconstruct(names).points.colors, atol=1e-6, rtol=0
    )
    assert (scene.temperature.min_c, scene.temperature.max_c) == (10.0, 30.0)
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert content["georeference"]["units"] == "metres"
    assert content["georeference"]["origin"]["longitude_deg"] == 11.5
    assert scene.world == METRIC.world
    np.testing.assert_allclose(content["thermal_from_rgb_m"], OFFSET)


@pytest.mark.parametrize("lens", [RGB_LENS, OTHER_RGB, FISHEYE])
def test_one_camera_serves_both_images_whatever_the_size_of_the_thermal_ones(tmp_path, lens):
    photos = convert(tmp_path, 3)
    names = [view.name for view in photos.views]
    write(tmp_path, photos, reconstruct(names, lens), None, None, eval_every=0, bounds=None)
    scene = load_scene(tmp_path)
    assert scene.eval == ()
    view = scene.train[1]
    assert_camera(view.images[RGB].camera, lens, viewmat(1))
    half = replace(
        lens,
        width=16,
        height=12,
        **{key: getattr(lens, key) / 2 for key in ("fx", "fy", "cx", "cy")},
    )
    assert_camera(view.images[THERMAL].camera, half, viewmat(1))


def test_what_the_camera_noted_stays_with_the_photo(tmp_path):
    photos = convert(tmp_path, 3)
    noted = PhotoFacts(
        "FLIR radiometric JPEG",
        "FLIR E60",
        "4711",
        datetime(2026, 1, 17, 6, 30),
        parameters=ObjectParameters(0.93, 2.0, 18.0, 18.0, 0.4),
        planck=Planck(15000.0, 0.0125, 1400.0, 1.0, -6000.0),
    )
    views = (replace(photos.views[0], facts=noted), *photos.views[1:])
    names = [view.name for view in views]
    write(tmp_path, replace(photos, views=views), reconstruct(names), None, None)
    scene = load_scene(tmp_path)
    records = {view.name: view.images[THERMAL].record for view in scene.views}
    assert records["shot_0"] == noted.record
    assert records["shot_1"].parameters is None
    assert noted.record.serial == "4711"


def test_each_view_may_have_a_lens_of_its_own(tmp_path):
    photos = convert(tmp_path, 4)
    names = [view.name for view in photos.views]
    reconstruction = reconstruct(names)
    reconstruction = replace(reconstruction, lenses={**reconstruction.lenses, "shot_2": OTHER_RGB})
    write(tmp_path, photos, reconstruction, rig_of(names), None, eval_every=0, bounds=None)
    lenses = [view.images[RGB].camera for view in load_scene(tmp_path).train]
    assert_camera(lenses[1], RGB_LENS, viewmat(1))
    assert_camera(lenses[2], OTHER_RGB, viewmat(2))


def test_a_thermal_only_set_has_poses_of_the_thermal_images(tmp_path):
    photos = convert(tmp_path, 9)
    names = [view.name for view in photos.views]
    reconstruction = replace(reconstruct(names, THERMAL_LENS), images=THERMAL)
    write(tmp_path, photos, reconstruction, None, None, eval_every=8, bounds=None)
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.eval] == ["shot_0", "shot_8"]
    assert all(RGB not in view.images for view in scene.train)
    assert_camera(scene.train[0].images[THERMAL].camera, THERMAL_LENS, viewmat(1))


@pytest.mark.parametrize(
    ("count", "held_out"), [(1, []), (2, ["shot_0"]), (7, ["shot_0"]), (9, ["shot_0", "shot_8"])]
)
def test_every_eighth_view_is_held_out(tmp_path, count, held_out):
    photos = convert(tmp_path, count)
    names = [view.name for view in photos.views]
    write(tmp_path, photos, reconstruct(names), rig_of(names), None, eval_every=8, bounds=None)
    assert [view.name for view in load_scene(tmp_path).eval] == held_out


def test_given_bounds_win(tmp_path):
    photos = convert(tmp_path, 3)
    names = [view.name for view in photos.views]
    write(
        tmp_path,
        photos,
        reconstruct(names),
        rig_of(names),
        None,
        eval_every=0,
        bounds=(-5.5, 90.0),
    )
    temperature = load_scene(tmp_path).temperature
    assert (temperature.min_c, temperature.max_c) == (-5.5, 90.0)


def test_what_an_earlier_call_left_is_taken_away(tmp_path):
    photos = convert(tmp_path, 3, celsius=False)
    names = [view.name for view in photos.views]
    reconstruction = reconstruct(names)
    write(tmp_path, photos, reconstruction, rig_of(names), None, eval_every=0, bounds=(0.0, 50.0))
    assert load_scene(tmp_path).temperature is not None
    empty = replace(reconstruction, points=PointCloud(torch.zeros(0, 3), torch.zeros(0, 3)))
    write(tmp_path, photos, empty, rig_of(names), None, eval_every=0, bounds=None)
    scene = load_scene(tmp_path)
    assert scene.temperature is None
    assert any("no start points" in note for note in scene.notes)


def test_a_set_without_poses_is_no_scene(tmp_path):
    with pytest.raises(SceneError, match="no view"):
        write(
            tmp_path, convert(tmp_path, 2), reconstruct([]), None, None, eval_every=8, bounds=None
        )


def test_a_view_without_thermal_camera_is_told(tmp_path):
    photos = convert(tmp_path, 3)
    names = [view.name for view in photos.views]
    with pytest.raises(SceneError, match=r"shot_2 .*calibration"):
        write(
            tmp_path,
            photos,
            reconstruct(names),
            rig_of(names[:2]),
            None,
            eval_every=0,
            bounds=None,
        )


def test_a_folder_that_cannot_be_written_leaves_no_transforms(tmp_path):
    photos = convert(tmp_path, 3)
    names = [view.name for view in photos.views]
    (tmp_path / "temperature_bounds.json").mkdir()
    with pytest.raises(RunError, match=r"temperature_bounds\.json .*written"):
        write(
            tmp_path,
            photos,
            reconstruct(names),
            rig_of(names),
            None,
            eval_every=0,
            bounds=None,
        )
    assert not (tmp_path / "transforms.json").exists()


def test_what_cannot_be_taken_away_is_told(tmp_path):
    photos = convert(tmp_path, 3, celsius=False)
    names = [view.name for view in photos.views]
    (tmp_path / "temperature_bounds.json").mkdir()
    with pytest.raises(RunError, match=r"temperature_bounds\.json .*removed"):
        write(
            tmp_path,
            photos,
            reconstruct(names),
            rig_of(names),
            None,
            eval_every=0,
            bounds=None,
        )
