from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.data import load_scene
from mrgs.errors import MrgsWarning, SceneError
from mrgs.scene import RGB, THERMAL
from tests.helpers.layouts import HEIGHT, WIDTH


def rgbt(writer) -> list[str]:
    names = [f"{split}/{i:03d}.jpg" for split in ("train", "test") for i in range(3)]
    for index, name in enumerate(names):
        writer.image(f"rgb/{name}", seed=index)
        writer.image(f"thermal/{name}", seed=10 + index)
    return names


@pytest.mark.parametrize("folder", ["sparse/0", "colmap/sparse/0", "sparse"])
def test_text_and_binary_give_the_same_scene(writer, folder):
    names = rgbt(writer)
    writer.colmap(names, binary=False, folder=folder)
    from_text = load_scene(writer.root)
    for path in (writer.root / folder).iterdir():
        path.unlink()
    writer.colmap(names, binary=True, folder=folder)
    from_binary = load_scene(writer.root)
    assert torch.equal(from_text.points.positions, from_binary.points.positions)
    assert torch.equal(from_text.points.colors, from_binary.points.colors)
    for one, other in zip(
        from_text.train + from_text.eval, from_binary.train + from_binary.eval, strict=True
    ):
        assert one.name == other.name
        assert one.images[RGB].camera.coincides_with(other.images[RGB].camera)
        assert torch.equal(one.images[THERMAL].load().values, other.images[THERMAL].load().values)


def test_rgbt_scenes(writer):
    writer.colmap(rgbt(writer), binary=True)
    scene = load_scene(writer.root)
    assert [view.name for view in scene.train] == ["train_000", "train_001", "train_002"]
    assert [view.name for view in scene.eval] == ["test_000", "test_001", "test_002"]
    assert all(view.shares_camera(RGB, THERMAL) for view in scene.train)
    assert scene.points.positions[2].tolist() == [-80, 1, 0]  # a far point is real
    assert any("luminance" in note for note in scene.notes)


def test_thermalmix(writer):
    """Arrays of shares of the highest temperature, warped into the RGB photos' cameras, beside the
    thermal camera's own images."""
    names = [f"IMG_{index}.JPG" for index in range(9)]
    shares = np.random.default_rng(0).uniform(0.4, 1.0, (len(names), HEIGHT, WIDTH))
    shares[:, :, :2] = 0
    (writer.root / "warped_thermal").mkdir()
    for name, share in zip(names, shares, strict=True):
        writer.image(f"rgb/{name.replace('JPG', 'jpg')}")
        writer.image(f"thermal/{name.replace('JPG', 'png')}", "L", (8, 8))
        np.save(writer.root / f"warped_thermal/{name[:-4]}.npy", share)
    writer.colmap(
        names,
        binary=True,
        model="PINHOLE",
        parameters=(20, 22, 12.5, 7.5),
        folder="colmap_sparse/0",
    )
    writer.bounds(0, 48.3)
    with (
        pytest.warns(MrgsWarning, match="shares of the scale"),
        pytest.warns(MrgsWarning, match="exactly 0"),
    ):
        scene = load_scene(writer.root)
    view = scene.train[0]
    assert view.shares_camera(RGB, THERMAL)
    pixels = view.images[THERMAL].load()
    assert not pixels.valid[:, :2].any()
    celsius = scene.temperature.to_celsius(pixels.values[:, 2:, 0])
    np.testing.assert_allclose(
        celsius, 48.3 * shares[names.index(f"{view.name}.JPG"), :, 2:], atol=1e-4
    )


def test_warped_images_elsewhere_are_not_taken(writer):
    for folder, mode in (("rgb", "RGB"), ("thermal", "F"), ("warped_thermal", "L")):
        writer.image(f"{folder}/a.{'tiff' if mode == 'F' else 'png'}", mode)
    writer.colmap(["a.png"], binary=True)
    assert load_scene(writer.root).temperature is not None


def test_names_in_the_model_may_be_bare_stems(writer):
    for index in range(4):
        writer.image(f"rgb/{('train', 'test')[index % 2]}/{index}.png", seed=index)
    writer.colmap([f"{index}.jpg" for index in range(4)], binary=True)
    scene = load_scene(writer.root)
    assert [view.name for view in scene.train] == ["0", "2"]
    assert [view.name for view in scene.eval] == ["1", "3"]


def test_the_pose_is_world_to_camera(writer):
    writer.image("images/a.png")
    writer.colmap(["a.png"], binary=False)
    writer.root.joinpath("sparse/0/images.txt").write_text(
        "1 0.7071067811865476 0 0 0.7071067811865476 1 2 3 1 a.png\n\n"
    )
    camera = load_scene(writer.root).train[0].images[RGB].camera
    np.testing.assert_allclose(
        camera.viewmat[:3], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]], atol=1e-12
    )


@pytest.mark.parametrize(("mode", "suffix"), [("L", "png"), ("I;16", "png"), ("F", "tiff")])
def test_images_of_one_channel_alone_are_thermal(writer, mode, suffix):
    names = [f"{index:04d}.{suffix}" for index in range(17)]
    for index, name in enumerate(names):
        writer.image(f"images/{name}", mode, seed=index)
    writer.colmap(names, binary=True)
    scene = load_scene(writer.root)
    assert RGB not in scene.modalities
    assert [view.name for view in scene.eval] == ["0000", "0008", "0016"]
    assert len(scene.train) == 14
    assert any("taken for thermal" in note for note in scene.notes)


def test_bounds_make_the_only_images_thermal(writer):
    Image.fromarray(np.full((HEIGHT, WIDTH, 3), 90, np.uint8)).save(writer.image("images/a.png"))
    writer.bounds(0.0, 50.0)
    writer.colmap(["a.png"], binary=True)
    scene = load_scene(writer.root)
    assert scene.modalities == (THERMAL,)
    assert scene.temperature.max_c == 50.0


def test_coloured_images_with_bounds_are_thermal_without_celsius(writer):
    writer.image("images/a.png")
    writer.bounds(0.0, 50.0)
    writer.colmap(["a.png"], binary=True)
    with pytest.warns(MrgsWarning, match="images/ are taken for thermal|colour palette") as told:
        scene = load_scene(writer.root)
    assert len(told) == 2
    assert scene.modalities == (THERMAL,)
    assert scene.temperature is None


def test_a_thermal_folder_alone(writer):
    writer.image("thermal/a.png", "L")
    writer.colmap(["a.png"], binary=True)
    assert RGB not in load_scene(writer.root).modalities


def test_colour_images_alone_are_rgb(writer):
    writer.image("images/a.png")
    writer.image("images/b.png")
    writer.colmap(["a.png"], binary=True)
    scene = load_scene(writer.root)
    assert THERMAL not in scene.modalities
    assert any("1 images" in note and "registered" in note for note in scene.notes)


def test_both_images_of_a_pair_may_be_registered(writer):
    for name in ("images/a.png", "thermal/a.png"):
        writer.image(name)
    writer.colmap(["images/a.png", "thermal/a.png"], binary=True)
    (view,) = load_scene(writer.root).train
    assert not view.shares_camera(RGB, THERMAL)
    assert not torch.equal(view.images[RGB].camera.viewmat, view.images[THERMAL].camera.viewmat)


BOTH = {
    "folders below one": ("images/rgb/{}.png", "images/thermal/{}.png", "images/"),
    "one folder within the other": ("images/{}.png", "images/IR/{}.png", "images/"),
    "words in one folder": ("images/rgb_{}.png", "images/thermal_{}.png", "images/"),
    "words at the end": ("images/{}-rgb.png", "images/{}-thermal.png", "images/"),
    "folders of both words": (
        "images/rgb_images/{}.png",
        "images/thermal_images/{}.png",
        "images/",
    ),
    "words in two folders": ("rgb/rgb_{}.png", "thermal/thermal_{}.png", ""),
    "a folder of images before": ("images/{}.png", "images_thermal/{}.png", ""),
}


@pytest.mark.parametrize(("rgb", "thermal", "root"), BOTH.values(), ids=BOTH)
@pytest.mark.parametrize("is_below_root", [True, False])
def test_both_cameras_in_one_model(writer, rgb, thermal, root, is_below_root):
    names = [each.format(number) for each in (rgb, thermal) for number in range(9)]
    for index, name in enumerate(names):
        writer.image(name, "L" if index >= 9 else "RGB", seed=index)
    writer.bounds(0.0, 50.0)
    writer.colmap([name.removeprefix(root if is_below_root else "") for name in names], True)
    scene = load_scene(writer.root)
    assert [view.name for view in scene.eval] == ["0", "8"]
    assert [view.name for view in scene.train] == [str(number) for number in range(1, 8)]
    for view in scene.train + scene.eval:
        assert view.images[RGB].files == (writer.root / rgb.format(view.name),)
        assert view.images[THERMAL].files == (writer.root / thermal.format(view.name),)
        assert not view.shares_camera(RGB, THERMAL)


@pytest.mark.parametrize(("rgb", "thermal", "root"), BOTH.values(), ids=BOTH)
def test_both_cameras_of_which_one_is_registered(writer, rgb, thermal, root):
    for number in range(3):
        writer.image(rgb.format(number), seed=number)
        writer.image(thermal.format(number), "L", seed=number)
    writer.colmap([rgb.format(number).removeprefix(root) for number in range(3)], True)
    scene = load_scene(writer.root)
    assert all(view.shares_camera(RGB, THERMAL) for view in scene.train + scene.eval)


def test_images_in_folders_of_two_cameras_need_no_partner(writer):
    names = ["rgb/front_1.png", "rgb/front_2.png", "thermal/1.png", "thermal/7.png"]
    for index, name in enumerate(names):
        writer.image(f"images/{name}", seed=index)
    writer.colmap(names, binary=True)
    scene = load_scene(writer.root)
    held = {view.name: tuple(view.images) for view in scene.train + scene.eval}
    assert held == {"front_1": (RGB,), "front_2": (RGB,), "1": (THERMAL,), "7": (THERMAL,)}
    assert any("told apart" in note for note in scene.notes)


@pytest.mark.parametrize("names", [["thermal_bath", "street_1"], ["IR/1", "hall/7"]])
def test_words_in_the_names_of_one_camera_tell_nothing(writer, names):
    for index, name in enumerate(names):
        writer.image(f"images/{name}.png", seed=index)
    writer.colmap([f"{name}.png" for name in names], binary=True)
    scene = load_scene(writer.root)
    assert scene.modalities == (RGB,)
    assert len(scene.train + scene.eval) == len(names)


@pytest.mark.parametrize(
    ("model", "parameters", "K"),
    [
        ("SIMPLE_PINHOLE", (20.0, 12.0, 8.0), (20, 20, 12, 8)),
        ("PINHOLE", (20.0, 21.0, 12.0, 8.0), (20, 21, 12, 8)),
        ("SIMPLE_RADIAL", (20.0, 12.0, 8.0, 0.0), (20, 20, 12, 8)),
        ("RADIAL", (20.0, 12.0, 8.0, 0.0, 0.0), (20, 20, 12, 8)),
        ("OPENCV", (20.0, 21.0, 12.0, 8.0, 0.0, 0.0, 0.0, 0.0), (20, 21, 12, 8)),
    ],
)
@pytest.mark.parametrize("binary", [True, False])
def test_camera_models(writer, model, parameters, K, binary):
    writer.image("images/a.png")
    writer.colmap(["a.png"], binary, model, parameters)
    got = load_scene(writer.root).train[0].images[RGB].camera.K
    assert (got[0, 0], got[1, 1], got[0, 2], got[1, 2]) == K


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("SIMPLE_RADIAL", (20.0, 12.0, 8.0, -0.1)),
        ("RADIAL", (20.0, 12.0, 8.0, 0.0, 0.1)),
        ("OPENCV_FISHEYE", (20.0, 20.0, 12.0, 8.0, 0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_distorting_camera_models_are_undistorted(writer, model, parameters):
    writer.image("images/a.png")
    writer.colmap(["a.png"], True, model, parameters)
    image = load_scene(writer.root).train[0].images[RGB]
    assert image.camera.K[0, 0] != 20
    assert image.load().valid is None


def damage_text(name, text):
    return lambda folder: (folder / name).write_text(text)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (damage_text("cameras.txt", "1 OPENCV 24\n"), "cameras.txt: line 1"),
        (damage_text("cameras.txt", "1 FOV 24 16 1 1 1 1 1\n"), "'FOV'; undistort"),
        (
            damage_text("cameras.txt", "1 PINHOLE 24 16 20 20 12\n"),
            "3 parameters .*PINHOLE",
        ),
        (damage_text("cameras.txt", "1 PINHOLE 24 16 0 20 12 8\n"), "must be positive"),
        (damage_text("cameras.txt", "1 PINHOLE 24 16 nan 20 12 8\n"), "NaN"),
        (damage_text("images.txt", "1 1 0 0 x 0 0 0 1 a.png\n\n"), "images.txt: line 1"),
        (damage_text("images.txt", "1 2 0 0 0 0 0 0 1 a.png\n\n"), "length 2"),
        (damage_text("images.txt", "1 1 0 0 0 nan 0 0 1 a.png\n\n"), "NaN"),
        (
            damage_text("images.txt", "1 1 0 0 0 0 0 0 9 a.png\n\n"),
            "camera 9",
        ),
        (
            damage_text("images.txt", "1 1 0 0 0 0 0 0 1 b.png\n\n"),
            "'b.png' is missing",
        ),
        (damage_text("images.txt", "# none\n"), "no registered image"),
        (damage_text("points3D.txt", "1 0 0\n"), "points3D.txt: line 1"),
    ],
)
def test_damaged_text(writer, damage, message):
    writer.image("images/a.png")
    damage(writer.colmap(["a.png"], binary=False))
    with pytest.raises(SceneError, match=message):
        load_scene(writer.root)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("kept", [0, 5, -1, "count"])
def test_cut_off_binary(writer, name, kept):
    writer.image("images/a.png")
    path = writer.colmap(["a.png"], binary=True) / name
    data = path.read_bytes()
    path.write_bytes(b"\xff" * 8 + data[8:] if kept == "count" else data[:kept])
    with pytest.raises(SceneError, match=f"{name}: .*cut off"):
        load_scene(writer.root)
