from __future__ import annotations

import math
import shutil
import unicodedata
import warnings

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.check.rules import warn_of_problems
from mrgs.data import load_scene
from mrgs.data.cameras import lens_from_json
from mrgs.data.files import on_disk
from mrgs.data.load import read_bounds
from mrgs.data.ply import read_ply
from mrgs.data.sources import ReadingNotes
from mrgs.errors import MrgsWarning, SceneError
from mrgs.scene import RGB, THERMAL
from tests.corpus.scenes import LENS, write_colours, write_pairs
from tests.helpers.layouts import SceneWriter

NAMES = [f"p{index}" for index in range(4)]


@pytest.fixture
def writer(tmp_path):
    return SceneWriter(tmp_path / "scene")


@pytest.mark.parametrize("thermal", ["thermal", "Thermal", "THERMAL", "infrared", "TIR"])
def test_the_thermal_folder_of_a_colmap_scene_in_any_case(writer, thermal):
    write_pairs(writer, "images", thermal, NAMES)
    folder = f"{thermal}/" if thermal.lower() == "thermal" else ""
    writer.bounds(10, 30, f"{folder}temperature_bounds.json")
    writer.colmap([f"{name}.png" for name in NAMES], binary=True)
    scene = load_scene(writer.root)
    assert scene.modalities == (RGB, THERMAL)
    assert scene.temperature is not None


def test_the_thermal_folder_of_a_nerfstudio_scene_in_any_case(writer):
    content = writer.thermoscenes()
    (writer.root / "thermal").rename(writer.root / "Thermal")
    for frame in content["frames"]:
        del frame["thermal_file_path"]
    writer.transforms(content)
    assert load_scene(writer.root).modalities == (RGB, THERMAL)


def test_training_says_where_no_thermal_image_is_found(writer):
    write_pairs(writer, "images", "second_camera", NAMES)
    writer.colmap([f"{name}.png" for name in NAMES], binary=False)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", MrgsWarning)
        warn_of_problems(load_scene(writer.root))
    assert any("no temperatures" in str(each.message) for each in said)


@pytest.mark.parametrize("preview", ["jpg", "tiff"])
def test_of_two_files_of_a_name_the_registered_one_is_used(writer, preview):
    write_pairs(writer, "rgb", "thermal", NAMES)
    for name in NAMES:
        writer.image(f"rgb/{name}.{preview}", seed=99)
    writer.colmap([f"{name}.png" for name in NAMES], binary=True)
    files = {view.images[RGB].files[0].suffix for view in load_scene(writer.root).train}
    assert files == {".png"}


def test_a_thermal_image_is_preferred_to_its_preview(writer):
    write_pairs(writer, "rgb", "thermal", NAMES)
    for name in NAMES:
        writer.image(f"thermal/{name}.tiff", "F")
    writer.colmap([f"{name}.png" for name in NAMES], binary=True)
    files = {view.images[THERMAL].files[0].suffix for view in load_scene(writer.root).train}
    assert files == {".tiff"}


@pytest.mark.parametrize("binary", [True, False])
def test_the_reconstruction_with_the_most_images_is_used(writer, binary):
    names = [f"p{index}" for index in range(14)]
    write_pairs(writer, "rgb", "thermal", names)
    writer.colmap([f"{name}.png" for name in names[:3]], binary, folder="sparse/0")
    writer.colmap([f"{name}.png" for name in names], binary, folder="sparse/1")
    scene = load_scene(writer.root)
    assert len(scene.views) == 14
    assert any("sparse" in note and "14" in note for note in scene.notes)


def test_what_a_mac_writes_beside_its_photos_is_no_photo(writer):
    write_pairs(writer, "rgb", "thermal", NAMES)
    for name in NAMES:
        (writer.root / f"rgb/._{name}.png").write_bytes(b"\x00\x05\x16\x07" + bytes(60))
    writer.colmap([f"{name}.png" for name in NAMES], binary=True)
    scene = load_scene(writer.root)
    assert len(scene.views) == len(NAMES)
    assert not any("left out" in note for note in scene.notes)


@pytest.mark.parametrize("content", [b"", b"\x01" * 9])
def test_a_reconstruction_that_was_interrupted_is_none(writer, content):
    write_pairs(writer, "rgb", "thermal", NAMES)
    writer.colmap([f"{name}.png" for name in NAMES], True, folder="sparse/0")
    for stem in ("cameras", "images"):
        (writer.root / "sparse/1").mkdir(exist_ok=True)
        (writer.root / f"sparse/1/{stem}.bin").write_bytes(content)
    assert len(load_scene(writer.root).views) == len(NAMES)


@pytest.mark.parametrize("name", ["north/day/{}.png", "north\\day\\{}.png", "{}.png"])
def test_colmap_names_two_folders_deep(writer, name):
    write_pairs(writer, "rgb/north/day", "thermal/north/day", NAMES)
    writer.colmap([name.format(each) for each in NAMES], binary=True)
    scene = load_scene(writer.root)
    assert len(scene.views) == len(NAMES)
    assert scene.modalities == (RGB, THERMAL)


@pytest.mark.parametrize(("named", "stored"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_names_in_another_unicode_form(writer, named, stored):
    """A Mac writes names in NFD, other systems in NFC."""
    names = [f"Gebäude_{index}" for index in range(4)]
    write_pairs(writer, "rgb", "thermal", [unicodedata.normalize(stored, name) for name in names])
    same = [unicodedata.normalize(named, name) for name in names]
    writer.colmap([f"{name}.png" for name in same], binary=True)
    assert len(load_scene(writer.root).views) == 4
    shutil.rmtree(writer.root / "sparse")
    pose = np.eye(4).tolist()
    frames = [{"file_path": f"rgb/{name}.png", "transform_matrix": pose} for name in same]
    held_out = [unicodedata.normalize(stored, same[1])]
    writer.transforms({**LENS, "frames": frames, "val_filenames": held_out})
    scene = load_scene(writer.root)
    assert (len(scene.train), len(scene.eval)) == (3, 1)
    assert scene.modalities == (RGB, THERMAL)


@pytest.mark.parametrize("form", ["images\\{}.png", "{}.png", "{}", "./images/{}.png"])
def test_split_lists_with_backslashes_or_bare_names(writer, form):
    content = writer.thermoscenes()
    content["test_filenames"] = [form.format("frame_train_00002")]
    writer.transforms(content)
    assert [view.name for view in load_scene(writer.root).eval] == ["frame_train_00002"]


def test_an_absolute_path_inside_the_scene_is_a_path_of_the_scene(writer):
    content = writer.thermoscenes()
    for frame in content["frames"]:
        frame["file_path"] = str(writer.root / frame["file_path"])
    content["test_filenames"] = [content["frames"][1]["file_path"]]
    writer.transforms(content)
    scene = load_scene(writer.root)
    assert scene.modalities == (RGB, THERMAL)
    assert [view.name for view in scene.eval] == ["frame_train_00001"]


def test_is_fisheye_of_instant_ngp_is_a_fisheye(tmp_path):
    values = {**LENS, "k1": 0.1, "k2": -0.02, "k3": 0.01, "k4": 0.001}
    flagged = lens_from_json({**values, "is_fisheye": True}, "all", tmp_path)
    named = lens_from_json({**values, "camera_model": "OPENCV_FISHEYE"}, "all", tmp_path)
    assert flagged == named
    assert flagged.fisheye
    assert not lens_from_json({**values, "is_fisheye": False}, "all", tmp_path).fisheye
    with pytest.raises(SceneError, match="is_fisheye"):
        lens_from_json({**values, "is_fisheye": "yes"}, "all", tmp_path)


@pytest.mark.parametrize(
    ("angles", "focal"),
    [
        ({"camera_angle_x": 2 * math.atan(24 / 60)}, (30.0, 30.0)),
        ({"x_fov": math.degrees(2 * math.atan(24 / 60))}, (30.0, 30.0)),
        ({"camera_angle_y": 2 * math.atan(16 / 60)}, (30.0, 30.0)),
        ({"fl_x": 20.0, "camera_angle_x": 0.1}, (20.0, 20.0)),
    ],
)
def test_an_angle_of_view_in_place_of_a_focal_length(tmp_path, angles, focal):
    size = {"w": 24, "h": 16}
    lens = lens_from_json({**size, **angles}, "all", tmp_path)
    np.testing.assert_allclose((lens.fx, lens.fy), focal)


@pytest.mark.parametrize("given", [{"camera_angle_x": 60.0}, {"fov": 60.0}, {}])
def test_a_missing_focal_length_is_asked_for(tmp_path, given):
    with pytest.raises(SceneError, match=r"no focal length.*camera_angle_x \(radians"):
        lens_from_json({"w": 24, "h": 16, **given}, "all", tmp_path)


def test_images_of_two_sizes_do_not_share_a_focal_length_in_pixels(writer):
    content = writer.thermoscenes()
    for path in (writer.root / "thermal").iterdir():
        image = Image.open(path)
        image.resize((image.width // 2, image.height // 2)).save(path)
    for key in ("w", "h"):
        del content[key]
    writer.transforms(content)
    with pytest.raises(SceneError, match="same fl_x; add w and h"):
        load_scene(writer.root)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("ftheta_p0", 0.1),
        ("ftheta_p1", 0.05),
        ("orthographic", True),
        ("latlong", True),
        ("rolling_shutter", [0, 0, 1, 0]),
        ("rolling_shutter", [[1], [2, 3]]),
        ("k5", 0.1),
        ("from_na", True),
        ("distortion_params", [0, 0.1, 0, 0, 0, 0]),
    ],
)
def test_a_key_that_changes_the_others_is_refused(writer, key, value):
    writer.transforms({**writer.thermoscenes(), key: value})
    with pytest.raises(SceneError, match=key):
        load_scene(writer.root)
    nothing = [0, 0, 0, 0] if isinstance(value, list) else 0
    writer.transforms({**writer.thermoscenes(), key: nothing})
    assert load_scene(writer.root).train


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize(
    ("model", "parameters", "radial", "fisheye"),
    [
        (
            "FULL_OPENCV",
            (20.0, 22.0, 12.5, 7.5, 0.1, 0.02, 0, 0, 0.003, 0, 0, 0),
            (0.1, 0.02, 0.003, 0),
            False,
        ),
        ("SIMPLE_RADIAL_FISHEYE", (20.0, 12.5, 7.5, 0.1), (0.1, 0, 0, 0), True),
        ("RADIAL_FISHEYE", (20.0, 12.5, 7.5, 0.1, 0.02), (0.1, 0.02, 0, 0), True),
    ],
)
def test_further_camera_models_of_colmap(writer, binary, model, parameters, radial, fisheye):
    from mrgs.data.colmap import find_model, read_images

    writer.colmap(["a.png"], binary, model, parameters)
    (image,) = read_images(find_model(writer.root))
    assert (image.lens.radial, image.lens.fisheye) == (radial, fisheye)


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("FULL_OPENCV", (20.0, 22.0, 12.5, 7.5, *[0.1] * 8)),
        ("FOV", (20.0, 22.0, 12.5, 7.5, 0.1)),
        ("THIN_PRISM_FISHEYE", (20.0, 22.0, 12.5, 7.5, *[0.0] * 8)),
    ],
)
def test_camera_models_that_are_not_read_are_named(writer, model, parameters):
    writer.image("images/a.png")
    writer.colmap(["a.png"], True, model, parameters)
    with pytest.raises(SceneError, match=f"{model}.*undistort"):
        load_scene(writer.root)


@pytest.mark.parametrize(
    ("text", "range_c"),
    [
        ('"min": 10', None),
        ('"units": "F", "community": "x"', (-12.2222, -1.1111)),
        ('"Unit": "kelvin"', (-263.15, -243.15)),
        ('"unit": "K*100"', None),
    ],
)
def test_the_unit_of_the_bounds(writer, text, range_c):
    ends = '"absolute_min_temperature": 10, "absolute_max_temperature": 30'
    if "min" in text:
        ends = '"max": 30'
    (writer.root / "temperature_bounds.json").write_text(f"{{{ends}, {text}}}")
    if range_c is None:
        with pytest.raises(SceneError, match=r"temperature_bounds\.json"):
            read_bounds(writer.root, ReadingNotes())
        return
    found = read_bounds(writer.root, ReadingNotes())
    np.testing.assert_allclose((found.min_c, found.max_c), range_c, atol=1e-3)


def test_bounds_that_look_like_kelvin_are_doubted(writer):
    writer.bounds(283, 303)
    notes = ReadingNotes()
    read_bounds(writer.root, notes)
    assert "looks like K" in notes.repaired[0]


def test_colours_of_a_point_cloud_in_sixteen_bits(tmp_path):
    colours = np.array([[0, 0.2, 1], [0.4, 0.6, 0.8]])
    path = write_colours(tmp_path / "points.ply", colours * 65535, "float")
    np.testing.assert_allclose(read_ply(path)[1], colours, atol=1e-4)
    text = path.read_bytes().replace(b"property float red", b"property float Red")
    path.write_bytes(text.replace(b"\nelement", b"\ncomment no end_header\nelement", 1))
    np.testing.assert_allclose(read_ply(path)[1], colours, atol=1e-4)


@pytest.mark.parametrize("kind", ["float", "double", "uchar"])
@pytest.mark.parametrize("white", [1, 255])
def test_colours_of_a_point_cloud_in_floats(tmp_path, kind, white):
    colours = np.array([[0, 0.2, 1], [0.4, 0.6, 0.8]])
    if kind == "uchar" and white == 1:
        pytest.skip("bytes span 0 to 255")
    path = write_colours(tmp_path / "points.ply", colours * white, kind)
    np.testing.assert_allclose(read_ply(path)[1], colours, atol=0.003)


def test_a_colour_that_is_infinite_leaves_the_others(tmp_path):
    colours = np.array([[0.5, 0.5, 0.5], [np.inf, 0.25, 0.5]])
    found = read_ply(write_colours(tmp_path / "points.ply", colours, "float"))[1]
    np.testing.assert_allclose(found, [[0.5, 0.5, 0.5], [1, 0.25, 0.5]])


def test_the_pixels_of_a_turned_image_are_those_that_colmap_saw(writer):
    write_pairs(writer, "rgb", "thermal", NAMES)
    pixels = np.array(Image.open(writer.root / "rgb/p1.png"))
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pixels).save(writer.root / "rgb/p1.png", exif=exif)
    writer.colmap([f"{name}.png" for name in NAMES], True, "PINHOLE", (20.0, 22.0, 12.5, 7.5))
    values = load_scene(writer.root).train[0].images[RGB].load().values
    assert torch.equal(values, torch.from_numpy(pixels.astype(np.float32)) / 255)


def test_folders_and_names_in_another_form_at_every_depth(tmp_path):
    place = tmp_path / "Gebäude" / "Thermal"
    place.mkdir(parents=True)
    (place / "Küche.png").write_bytes(b"")
    wanted = unicodedata.normalize("NFD", "gebäude/thermal/Küche.png")
    assert on_disk(tmp_path, wanted) == "Gebäude/Thermal/Küche.png"
    assert on_disk(tmp_path, "gebäude\\other\\a") == "Gebäude/other/a"
