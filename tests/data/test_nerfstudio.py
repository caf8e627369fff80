from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.data import load_scene
from mrgs.data.transforms import world_json
from mrgs.errors import MrgsWarning, SceneError
from mrgs.scene import (
    RGB,
    THERMAL,
    EarthPosition,
    Modality,
    TemperatureRange,
    WorldFrame,
    known_modalities,
)
from tests.helpers.layouts import orbit_pose


def test_thermoscenes(writer):
    content = writer.thermoscenes()
    writer.transforms(content)
    writer.bounds(10.0, 30.0, "thermal/temperature_bounds.json")
    scene = load_scene(writer.root)

    assert [view.name for view in scene.train] == [f"frame_train_{i:05d}" for i in range(4)]
    assert [view.name for view in scene.eval] == ["frame_eval_00000", "frame_eval_00001"]
    assert scene.temperature == TemperatureRange(10.0, 30.0)
    assert scene.points.positions.shape == (20_000, 3)
    view = scene.train[1]
    assert view.shares_camera(RGB, THERMAL)
    assert torch.equal(
        view.images[RGB].camera.K,
        torch.tensor([[20.0, 0, 12.5], [0, 22.0, 7.5], [0, 0, 1]]).double(),
    )
    c2w = np.array(content["frames"][1]["transform_matrix"])
    np.testing.assert_allclose(view.images[RGB].camera.position, c2w[:3, 3], atol=1e-12)
    np.testing.assert_allclose(view.images[RGB].camera.forward, -c2w[:3, 2], atol=1e-12)
    thermal = view.images[THERMAL].load()
    stored = np.asarray(Image.open(writer.root / "thermal/frame_train_00001.PNG"))
    np.testing.assert_array_equal(thermal.values[..., 0], stored.astype(np.float32) / 255)
    assert thermal.valid is None
    assert view.images[RGB].load().values.shape == (16, 24, 3)


def test_the_frame_of_the_world_is_known_where_prepare_has_found_it(writer):
    content = writer.thermoscenes()
    writer.transforms(content)
    assert load_scene(writer.root).world == WorldFrame()
    origin = {"latitude_deg": 48.1, "longitude_deg": 11.5, "altitude_m": None}
    facts = {"units": "metres", "axes": "east north up", "origin": origin}
    writer.transforms({**content, "georeference": facts})
    world = load_scene(writer.root).world
    assert world == WorldFrame(True, True, EarthPosition(48.1, 11.5, None))
    assert (world.length_unit, WorldFrame().length_unit) == ("m", "scene units")
    errors = {"residual_m": 0.8, "scale_error": 0.004}
    writer.transforms({**content, "georeference": {**facts, **errors}})
    assert load_scene(writer.root).world == replace(world, **errors)
    survey = {"offset": (5000.0, 100.0, 0.0), "control_m": 0.012}
    writer.transforms({**content, **world_json(WorldFrame(True, True, **survey))})
    assert load_scene(writer.root).world == WorldFrame(True, True, **survey)


def test_older_scenes_have_transforms_thermal_json(writer):
    writer.json("transforms_thermal.json", writer.thermoscenes())
    assert len(load_scene(writer.root).train) == 4


def test_the_transforms_file_itself_may_be_given(writer):
    assert len(load_scene(writer.json("transforms_3.json", writer.thermoscenes())).train) == 4


def test_swapped_bounds_are_mended_with_a_warning(writer):
    writer.transforms(writer.thermoscenes())
    writer.bounds(30.0, 10.0)
    with pytest.warns(MrgsWarning, match="swapped"):
        scene = load_scene(writer.root)
    assert scene.temperature == TemperatureRange(10.0, 30.0)
    assert any("swapped" in note for note in scene.notes)


def test_missing_bounds_are_noted(writer):
    writer.transforms(writer.thermoscenes())
    scene = load_scene(writer.root)
    assert scene.temperature is None
    assert any("temperature_bounds.json" in note for note in scene.notes)


def test_plain_nerfstudio_without_thermal(writer):
    content = writer.thermoscenes()
    for frame in content["frames"]:
        del frame["thermal_file_path"]
    for path in (writer.root / "thermal").iterdir():
        path.unlink()
    writer.transforms(content)
    scene = load_scene(writer.root)
    assert scene.modalities == (RGB,)
    assert scene.temperature is None


def test_thermal_images_are_found_by_stem_where_the_file_does_not_name_them(writer):
    content = writer.thermoscenes()
    for frame in content["frames"]:
        del frame["thermal_file_path"]
    (writer.root / "thermal/frame_train_00002.PNG").unlink()
    writer.transforms(content)
    scene = load_scene(writer.root)
    assert [THERMAL in view.images for view in scene.train] == [True, True, False, True]
    assert any("1 of 6" in note and "thermal" in note for note in scene.notes)


def test_thermal_alone(writer):
    content = writer.thermoscenes()
    for frame in content["frames"]:
        frame["file_path"] = frame.pop("thermal_file_path")
    writer.transforms(content)
    scene = load_scene(writer.root)
    assert scene.modalities == (THERMAL,)
    assert len(scene.eval) == 2


@pytest.mark.parametrize("folder", ["images_thermal", "thermal_images", "images"])
@pytest.mark.parametrize(("no", "yes"), [(0, 1), (False, True)])
def test_frames_of_one_camera_each(writer, folder, no, yes):
    content = writer.thermoscenes()
    content["frames"] = []
    for index in range(8):
        rgb, thermal = f"images/{index}.png", f"{folder}/{'t' * (folder == 'images')}{index}.png"
        for each, name in enumerate((rgb, thermal)):
            writer.image(name, "L" if each else "RGB", seed=index)
            pose = orbit_pose(0.7 * index + 0.1 * each).tolist()
            frame = {"file_path": name, "transform_matrix": pose, "fl_x": 20.0 + each}
            content["frames"].append(frame | {"is_thermal": yes if each else no})
    writer.transforms(content)
    scene = load_scene(writer.root)
    views = scene.train + scene.eval
    assert sorted([each.name for each in view.images] for view in views) == (
        [["rgb"]] * 8 + [["thermal"]] * 8
    )
    for view in views:
        is_thermal = THERMAL in view.images
        (image,) = view.images.values()
        assert image.camera.K[0, 0] == 20.0 + is_thermal
        assert (folder in str(image.files[0].relative_to(writer.root))) or not is_thermal


def test_a_frame_that_says_oddly_whether_it_is_thermal(writer):
    content = writer.thermoscenes()
    content["frames"][2]["is_thermal"] = "no"
    writer.transforms(content)
    with pytest.raises(SceneError, match="is_thermal of frame 2 is 'no'"):
        load_scene(writer.root)


@pytest.mark.parametrize("folder", ["images_thermal", "thermal_images"])
def test_further_names_of_the_folder_of_thermal_images(writer, folder):
    content = writer.thermoscenes()
    (writer.root / "thermal").rename(writer.root / folder)
    for frame in content["frames"]:
        del frame["thermal_file_path"]
    writer.transforms(content)
    scene = load_scene(writer.root)
    assert all(view.images.keys() == {RGB, THERMAL} for view in scene.train + scene.eval)
    for frame in content["frames"]:
        frame["file_path"] = f"{folder}/{frame['file_path'].split('/')[1]}"
    writer.transforms(content)
    assert load_scene(writer.root).modalities == (THERMAL,)


NIR = Modality("nir", 1)


def test_a_scene_may_list_further_modalities(writer):
    content = writer.thermoscenes(train=2, held_out=0)
    for index in range(2):
        writer.image(f"nir/frame_train_{index:05d}.png", "L", seed=200 + index)
    writer.transforms(content)
    assert load_scene(writer.root).modalities == (RGB, THERMAL)
    content["modalities"] = [{"name": "nir", "channels": 1, "unit": None, "title": "Near infrared"}]
    writer.transforms(content)
    scene = load_scene(writer.root)
    assert scene.modalities == (RGB, THERMAL, NIR)
    assert scene.modalities[2].title == "Near infrared"
    assert scene.train[0].images[NIR].load().values.shape == (16, 24, 1)
    assert NIR not in known_modalities()  # another scene is not changed by this one


def test_a_further_modality_may_have_a_camera_a_pose_and_a_mask_of_its_own(writer):
    content = writer.thermoscenes(train=2, held_out=1)
    content["modalities"] = [{"name": "nir", "channels": 1}]
    content["nir_camera"] = {"fl_x": 10.0, "w": 12, "h": 8}
    pose = content["frames"][1]["transform_matrix"]
    frame = content["frames"][0]
    frame |= {"nir_file_path": "infra/a.png", "nir_transform_matrix": pose}
    writer.image("infra/a.png", "L", (12, 8))
    Image.fromarray(np.eye(8, 12, dtype=np.uint8) * 255).save(writer.root / "mask.png")
    frame["nir_mask_path"] = "mask.png"
    writer.transforms(content)
    image = load_scene(writer.root).train[0].images[NIR]
    assert (image.camera.width, image.camera.height) == (12, 8)
    np.testing.assert_allclose(image.camera.position, np.array(pose)[:3, 3], atol=1e-12)
    assert image.load().valid.sum() == 8


def test_a_frame_may_have_its_own_intrinsics(writer):
    content = writer.thermoscenes()
    content["frames"][0].update(fl_x=30.0, k1=0.1)
    writer.transforms(content)
    first, second = load_scene(writer.root).train[:2]
    assert first.images[RGB].camera.K[0, 0] != second.images[RGB].camera.K[0, 0] == 20.0
    assert first.shares_camera(RGB, THERMAL)


def test_two_cameras(writer):
    content = writer.thermoscenes()
    content["thermal_camera"] = {
        "camera_model": "OPENCV",
        "w": 12,
        "h": 10,
        "fl_x": 9.0,
        "fl_y": 9.5,
        "cx": 6,
        "cy": 5,
    }
    content["k1"] = -0.1
    for index, frame in enumerate(content["frames"]):
        writer.image(frame["thermal_file_path"].replace(".png", ".PNG"), "L", (12, 10), index)
        pose = np.array(frame["transform_matrix"])
        pose[0, 3] += 0.25
        frame["thermal_transform_matrix"] = pose.tolist()
    writer.transforms(content)
    view = load_scene(writer.root).train[0]
    assert not view.shares_camera(RGB, THERMAL)
    assert (view.images[THERMAL].camera.width, view.images[THERMAL].camera.height) == (12, 10)
    assert view.images[THERMAL].camera.K[0, 0] == 9.0  # k1 belongs to the RGB camera alone
    assert view.images[RGB].camera.K[0, 0] != 20.0
    np.testing.assert_allclose(
        view.images[THERMAL].camera.position - view.images[RGB].camera.position,
        [0.25, 0, 0],
        atol=1e-12,
    )
    assert view.images[THERMAL].load().values.shape == (10, 12, 1)


def test_distorted_pairs_stay_on_one_grid_at_any_resolution(writer):
    content = writer.thermoscenes()
    content.update(k1=-0.2, p2=0.02)
    writer.transforms(content)
    view = load_scene(writer.root, resolution=12).train[0]
    assert view.shares_camera(RGB, THERMAL)
    assert (view.images[RGB].camera.width, view.images[RGB].camera.height) == (12, 8)
    assert view.images[RGB].load().values.shape == (8, 12, 3)
    assert view.images[THERMAL].load().values.shape == (8, 12, 1)


def test_masks_from_the_file_and_from_the_folder(writer):
    content = writer.thermoscenes()
    mask = np.full((16, 24), 255, dtype=np.uint8)
    mask[:, :6] = 0
    for name in (
        "own.png",
        "masks/frame_train_00001.png",
        "thermal_masks/frame_train_00001.jpg.png",
    ):
        (writer.root / name).parent.mkdir(exist_ok=True)
        Image.fromarray(mask).save(writer.root / name)
    content["frames"][0]["thermal_mask_path"] = "own.png"
    writer.transforms(content)
    first, second = load_scene(writer.root).train[:2]
    assert first.images[RGB].load().valid is None
    assert torch.equal(first.images[THERMAL].load().valid, torch.from_numpy(mask > 0))
    assert torch.equal(second.images[RGB].load().valid, torch.from_numpy(mask > 0))


def test_explicit_lists_win_over_names(writer):
    content = writer.thermoscenes()
    paths = [frame["file_path"] for frame in content["frames"]]
    content["train_filenames"] = [path.replace(".png", ".JPG") for path in paths[2:]]
    content["val_filenames"], content["test_filenames"] = [paths[0]], ["./" + paths[0]]
    writer.transforms(content)
    scene = load_scene(writer.root)
    assert [view.name for view in scene.eval] == ["frame_train_00000"]
    assert len(scene.train) == 4
    assert any("1 frames" in note for note in scene.notes)


PLY = (
    "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty "
    "float z\nend_header\n"
)


@pytest.mark.parametrize("name", ["sparse_pc.ply", "clouds/mine.ply"])
def test_points_of_a_ply_are_scaled_but_not_turned(writer, name):
    content = writer.thermoscenes()
    content["applied_transform"] = [[0, 1, 0, 5], [1, 0, 0, 0], [0, 0, -1, 0]]
    content["applied_scale"] = 2.0
    if name != "sparse_pc.ply":
        content["ply_file_path"] = name
    path = writer.root / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(PLY + "1 2 3\n-75 0 0.5\n")
    writer.transforms(content)
    assert load_scene(writer.root).points.positions.tolist() == [[2, 4, 6], [-150, 0, 1]]


@pytest.mark.parametrize("binary", [True, False])
def test_points_of_colmap_are_turned_and_scaled(writer, binary):
    content = writer.thermoscenes()
    writer.colmap(["a.png"], binary, folder="colmap/sparse/0")
    content["applied_transform"] = [[0, 1, 0, 5], [1, 0, 0, 0], [0, 0, -1, 0]]
    content["applied_scale"] = 2.0
    writer.transforms(content)
    points = load_scene(writer.root).points
    assert points.positions.tolist() == [[9.5, 1.0, -0.25], [14, 2, -6], [12, -160, 0]]
    np.testing.assert_allclose(points.colors[0], [1, 0, 0.2], atol=1e-6)
    del content["applied_transform"]
    writer.transforms(content)
    scene = load_scene(writer.root)
    assert scene.points.positions[0].tolist() == [-0.5, 1.0, -0.25]
    assert any("no applied_transform" in note for note in scene.notes)


def test_points_that_are_not_finite_are_dropped_with_a_warning(writer):
    writer.transforms(writer.thermoscenes())
    (writer.root / "sparse_pc.ply").write_text(PLY + "1 2 nan\n1 2 3\n")
    with pytest.warns(MrgsWarning, match="1 start points"):
        assert load_scene(writer.root).points.positions.tolist() == [[1, 2, 3]]


def set_pose(entry):
    def change(content):
        content["frames"][1]["transform_matrix"][0][0] = entry

    return change


def put(**values):
    return lambda content: content.update(values)


def put_frame(**values):
    return lambda content: content["frames"][1].update(values)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put(frames={}), '"frames" is {}'),
        (put(frames=[]), r'"frames" is \[\]'),
        (put(frames=[3]), "frame 0 is 3"),
        (put(frames=[{}]), "no file_path"),
        (put_frame(file_path=7), "file_path .* is 7"),
        (put_frame(file_path="images/none.png"), "'images/none.png' .*missing"),
        (
            put_frame(thermal_file_path="thermal/none.png"),
            "'thermal/none.png' .*missing",
        ),
        (put_frame(mask_path="none.png"), "'none.png' .*missing"),
        (put_frame(file_path="/etc/passwd"), "leaves the scene"),
        (put_frame(file_path="../outside.png"), "leaves the scene"),
        (put_frame(file_path="images/link.png"), "leaves the scene"),
        (put_frame(file_path="a\0b"), "not a usable path"),
        (put_frame(file_path="x" * 5000), "missing|usable"),
        (put(ply_file_path="../points.ply"), "leaves the scene"),
        (put(ply_file_path="none.ply"), "none.ply: cannot"),
        (put(ply_file_path=[]), r"ply_file_path is \[\]"),
        (put_frame(transform_matrix=[[1, 0, 0], [0, 1, 0]]), "3×4 or 4×4"),
        (put_frame(transform_matrix=None), "3×4 or 4×4"),
        (
            put_frame(transform_matrix=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]]),
            "last row",
        ),
        (set_pose("1.0"), r"transform_matrix .*\[0\]\[0\]: .*`float`"),
        (set_pose(math.nan), r"transform_matrix .*\[0\]\[0\]: .*finite"),
        (set_pose(10**400), r"transform_matrix .*\[0\]\[0\]: .*range"),
        (set_pose(3.0), "not a rotation"),
        (put_frame(thermal_transform_matrix=np.diag([1.0, 1, -1, 1]).tolist()), "not a rotation"),
        (put(fl_x="20"), "fl_x .* is '20'"),
        (put(fl_x=None, fl_y=None), "no focal length; .*fl_x"),
        (put(fl_x=True), "fl_x .* is True"),
        (put(fl_x=math.nan), "fl_x .* is nan"),
        (put(fl_y=10**400), "fl_y .*range"),
        (put(fl_y=0), "focal length .*positive"),
        (put(fl_x=-20.0), "focal length .*positive"),
        (put(fl_x=1e-308), "focal length .*positive"),
        (put(applied_scale=0), "applied_scale is 0"),
        (put(w=24.5), "is not whole"),
        (put(h=0), "image size .*possible"),
        (put(w=48), "24×16 px, .*48×16 px"),
        (put(camera_model="EQUIRECTANGULAR"), "'EQUIRECTANGULAR'; undistort"),
        (put(camera_model=["OPENCV"]), "camera_model is"),
        (put(thermal_camera=3), "thermal_camera is 3"),
        (put(k1=-1e5, k2=1e6), "fold the image"),
        (put(train_filenames="all"), "train_filenames is 'all'"),
        (put(train_filenames=[]), "left for training"),
        (put(applied_scale="2"), "applied_scale is '2'"),
        (put(georeference="east"), "georeference: .*`object`"),
        (put(georeference={"origin": [48, 11]}), "georeference: origin: .*prepare"),
        (put(georeference={"origin": {"latitude_deg": 48}}), "longitude_deg"),
        (
            put(georeference={"origin": {"latitude_deg": 91, "longitude_deg": 0}}),
            r"origin\.latitude_deg: .*90",
        ),
        (put(georeference={"residual_m": "1"}), "residual_m: .*`float"),
        (put(georeference={"scale_error": -0.1}), "scale_error: .*>= 0"),
        (put(georeference={"scale_error": math.inf}), "scale_error: .*float"),
        (put_frame(thermal_record=3), "thermal_record .*`object`"),
        (put(modalities="nir"), "modalities is 'nir'"),
        (put(modalities=[{}] * 17), "modalities .*16"),
        (put(modalities=["nir"]), "modalities: .*`object`"),
        (put(modalities=[{"channels": 1}]), "modalities: .*`name`"),
        (put(modalities=[{"name": "nir"}]), "modalities: .*`channels`"),
        (put(modalities=[{"name": "nir", "channels": True}]), "channels: .*`int`"),
        (put(modalities=[{"name": "nir", "channels": 10**400}]), "1000.* channels|channels: "),
        (put(modalities=[{"name": "nir", "channels": 2}]), "has 2 channels"),
        (put(modalities=[{"name": "nir", "channels": 0}]), "at least one channel"),
        (put(modalities=[{"name": "../nir", "channels": 1}]), "lower-case identifier"),
        (put(modalities=[{"name": "n" * 5000, "channels": 1}]), "40 characters"),
        (put(modalities=[{"name": "nir", "channels": 1, "title": "\x1b[2J"}]), "be printable"),
        (put(modalities=[{"name": "nir", "channels": 1, "unit": 3}]), "unit: .*`str"),
        (put(modalities=[{"name": "images", "channels": 1}]), "images has another"),
        (put(modalities=[{"name": "depth_rgb", "channels": 1}]), "depth_rgb has another"),
        (put(modalities=[{"name": "rgb", "channels": 1}]), "rgb has 1"),
    ],
)
@pytest.mark.filterwarnings("ignore::mrgs.errors.MrgsWarning")
def test_errors_are_one_clear_line(writer, change, message):
    content = writer.thermoscenes()
    Image.new("RGB", (24, 16)).save(writer.root.parent / "outside.png")
    (writer.root / "images/link.png").symlink_to(writer.root.parent / "outside.png")
    change(content)
    writer.transforms(content)
    with pytest.raises(SceneError, match=message) as caught:
        load_scene(writer.root)
    assert "\n" not in str(caught.value)
    assert str(writer.root) in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", r"transforms\.json: .*valid JSON"),
        ("[" * 100_000, "valid JSON"),
        ("\xff\xfe", "valid JSON"),
        ("9" * 10_000, "valid JSON"),
        ("[1, 2]", r"\[1, 2\]"),
    ],
)
def test_damaged_json(writer, text, message):
    (writer.root / "transforms.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(SceneError, match=message):
        load_scene(writer.root)


@pytest.mark.parametrize("other", ["transforms_b.json", "transforms_train_2.json"])
def test_several_transforms_files_are_not_guessed_between(writer, other):
    for name in ("transforms_train.json", other):
        writer.json(name, writer.thermoscenes())
    with pytest.raises(SceneError, match="several transforms files"):
        load_scene(writer.root)


@pytest.fixture
def splits(writer):
    """A scene of one file for each split, as NeRF's synthetic ones: equal names in two folders,
    without extensions, one angle of view for each file."""
    for split, size in (("train", (16, 12)), ("test", (20, 16))):
        frames = []
        for index in range(3):
            name = f"{split}/r_{index}.png"
            writer.image(name, "RGB", size, seed=index)
            writer.image(f"thermal/{name}", "L", size, seed=index + 10 * (split == "test"))
            pose = orbit_pose(0.1 * index + (split == "test")).tolist()
            frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": pose})
        angle = {"train": 0.7, "test": 0.9}[split]
        writer.json(f"transforms_{split}.json", {"camera_angle_x": angle, "frames": frames})
    return writer.root


@pytest.mark.parametrize("file", ["", "transforms_train.json"])
def test_a_file_for_each_split_is_one_scene(splits, file):
    scene = load_scene(splits / file)
    assert [len(scene.train), len(scene.eval)] == [3, 3]
    for views, split, size, angle in (
        (scene.train, "train", (16, 12), 0.7),
        (scene.eval, "test", (20, 16), 0.9),
    ):
        for view in views:
            image = view.images[RGB]
            stored = (
                np.asarray(
                    Image.open(splits / "thermal" / split / f"{view.name[-3:]}.png"), np.float32
                )
                / 255
            )
            assert view.name.startswith(f"{split}_r_")
            np.testing.assert_array_equal(view.images[THERMAL].load().values[..., 0], stored)
            assert (image.camera.width, image.camera.height) == size
            assert image.camera.K[0, 0].item() == pytest.approx(size[0] / 2 / math.tan(angle / 2))


def test_images_that_are_frames_of_their_own_are_no_partners(writer):
    """Both cameras' images in one reconstruction: each with its pose and lens, and the two of a
    moment on one side of the split."""
    frames = []
    for index in range(9):
        for folder, mode, focal in (("images", "RGB", 20.0), ("thermal", "F", 40.0)):
            suffix = "tiff" if mode == "F" else "png"
            name = f"{folder}/{index:02d}.{suffix}"
            writer.image(name, mode, seed=index)
            pose = orbit_pose(0.2 * index + 0.01 * (mode == "F")).tolist()
            lens = {"fl_x": focal, "w": 24, "h": 16}
            frames.append({"file_path": name, "transform_matrix": pose, **lens})
    writer.transforms({"frames": frames})
    scene = load_scene(writer.root)
    for views, indices in ((scene.train, [1, 2, 3, 4, 5, 6, 7]), (scene.eval, [0, 8])):
        assert [[*view.images] for view in views] == [[RGB], [THERMAL]] * len(indices)
        for at, view in enumerate(views):
            (image,) = view.images.values()
            assert image.camera.K[0, 0] == (40 if THERMAL in view.images else 20)
            assert view.name == f"{('images', 'thermal')[at % 2]}_{indices[at // 2]:02d}"


@pytest.mark.parametrize(
    "form", ["images/{:04d}/rgb.png", "images/{:04d}/left.png", "b/images/{:04d}.png"]
)
def test_folders_of_other_meanings_change_no_split(writer, form):
    names = [form.format(index) for index in range(9)]
    names += [name.replace("left", "right").replace("b/", "a/") for name in names]
    for name in (names := [*dict.fromkeys(names)]):
        writer.image(name)
    lens = {"fl_x": 20.0, "w": 24, "h": 16}
    frames = [
        {"file_path": name, "transform_matrix": orbit_pose(0.1 * at).tolist()}
        for at, name in enumerate(names)
    ]
    writer.transforms({**lens, "frames": frames})
    scene = load_scene(writer.root)
    assert len(scene.eval) == -(-len(names) // 8)
    assert len(scene.train) + len(scene.eval) == len(names)


def test_arrays_beside_photos_are_not_looked_at(writer):
    """As features, or depths, of NeRF-like scenes, whose frames name no extensions."""
    writer.image("images/a.png")
    np.save(writer.root / "images/a.npy", np.zeros((16, 24, 8)))
    pose = orbit_pose(0.0).tolist()
    lens = {"fl_x": 20.0, "w": 24, "h": 16}
    writer.transforms({**lens, "frames": [{"file_path": "images/a", "transform_matrix": pose}]})
    assert load_scene(writer.root).train[0].images[RGB].load().values.shape == (16, 24, 3)


@pytest.mark.parametrize(("val", "counts"), [("train", [3, 3]), ("test", [3, 3]), ("own", [3, 4])])
def test_a_validation_split_may_be_that_of_another(writer, splits, val, counts):
    content = json.loads(
        (splits / f"transforms_{'test' if val == 'own' else val}.json").read_text()
    )
    if val == "own":
        writer.image("val/r_0.png")
        content["frames"] = [{**content["frames"][0], "file_path": "./val/r_0"}]
    writer.json("transforms_val.json", content)
    scene = load_scene(splits)
    assert [len(scene.train), len(scene.eval)] == counts


def test_a_frame_of_both_splits_is_held_out(writer, splits):
    content = json.loads((splits / "transforms_test.json").read_text())
    content["frames"].append({**content["frames"][0], "file_path": "./train/r_1"})
    writer.json("transforms_test.json", content)
    scene = load_scene(splits)
    assert [len(scene.train), len(scene.eval)] == [2, 4]


@pytest.mark.parametrize("folder", ["infrared", "ir", "lwir"])
def test_thermal_folders_have_the_names_that_they_have_beside_colmap(writer, folder):
    writer.image("images/a.png")
    writer.image(f"{folder}/a.png", "L")
    lens = {"fl_x": 20.0, "w": 24, "h": 16}
    pose = orbit_pose(0.0).tolist()
    writer.transforms({**lens, "frames": [{"file_path": "images/a.png", "transform_matrix": pose}]})
    assert THERMAL in load_scene(writer.root).modalities


def test_frames_of_another_split_are_checked_as_well(writer, splits):
    writer.json("transforms_val.json", {"frames": [3]})
    with pytest.raises(SceneError, match=r"transforms_val\.json: .*frames"):
        load_scene(splits)


def test_a_mask_of_another_size_is_refused(writer):
    content = writer.thermoscenes()
    writer.image("mask.png", "L", (8, 8))
    content["frames"][0]["mask_path"] = "mask.png"
    writer.transforms(content)
    with pytest.raises(SceneError, match=r"mask\.png: .*8×8"):
        load_scene(writer.root)


def test_truncated_pixels_are_found_when_loaded(writer):
    writer.transforms(writer.thermoscenes())
    path = writer.root / "thermal/frame_train_00000.PNG"
    path.write_bytes(path.read_bytes()[:150])
    with pytest.raises(SceneError, match=r"frame_train_00000\.PNG: .*decoded"):
        load_scene(writer.root).train[0].images[THERMAL].load()


def test_points_outside_the_folder_are_not_followed(writer, tmp_path: Path):
    writer.transforms(writer.thermoscenes())
    (writer.root / "sparse_pc.ply").symlink_to(tmp_path / "elsewhere.ply")
    (tmp_path / "elsewhere.ply").write_text(PLY + "1 2 3\n1 2 3\n")
    with pytest.raises(SceneError, match="leaves the scene"):
        load_scene(writer.root)
