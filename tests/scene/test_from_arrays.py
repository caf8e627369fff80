"""A scene from arrays is the scene that the same images make in a folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.data import load_scene
from mrgs.errors import MrgsWarning, SceneError
from mrgs.scene import RGB, THERMAL, Camera, Scene, TemperatureRange
from mrgs.scene.lens import Lens
from mrgs.scene.point_cloud import RANDOM_POINTS
from tests.helpers.array_checks import unchecked

CAMERA = Camera.from_fov(8, 6, 60)
CAMERAS = [CAMERA.look_at([3 * np.cos(a), 3 * np.sin(a), 1], [0, 0, 0]) for a in range(9)]
RGB_IMAGES = np.random.default_rng(0).integers(0, 256, (9, 6, 8, 3), dtype=np.uint8)
CELSIUS = np.random.default_rng(1).uniform(12.3, 31.7, (9, 6, 8)).astype(np.float32)


def test_it_is_the_scene_of_the_folder(small_scene: Path):
    folder = load_scene(small_scene)
    views = sorted(folder.views, key=lambda view: view.name[-5:])
    files = sorted((small_scene / "images").iterdir(), key=lambda path: path.stem[-5:])
    made = Scene.from_arrays(
        [view.camera for view in views],
        rgb=[np.asarray(Image.open(path)) for path in files],
        celsius=[view.images[THERMAL].load().values[..., 0] * 20 + 10 for view in views],
        points=folder.points.positions,
        colors=folder.points.colors.numpy(),
        eval_every=0,
    )
    assert made.modalities == folder.modalities
    for view, original in zip(made.train, views, strict=True):
        for modality in (RGB, THERMAL):
            expected = original.images[modality].load().values
            if modality == THERMAL:
                expected = made.temperature.from_celsius(folder.temperature.to_celsius(expected))
            found = view.images[modality].load()
            torch.testing.assert_close(found.values, expected, rtol=0, atol=1e-6)
            assert found.valid is None
    assert torch.equal(made.points.positions, folder.points.positions)


BROWN, FISHEYE = [-0.25, 0.08, 0.002, -0.001, 0.01], [-0.05, 0.01, -0.004, 0.001]


def written(folder: Path, camera: Camera, colors: np.ndarray, lens: dict) -> Path:
    """A folder in nerfstudio's layout with two equal views of a camera that distorts."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for name in ("one", "two"):
        Image.fromarray(colors).save(folder / "images" / f"{name}.png")
        pose = torch.linalg.inv(camera.viewmat) * torch.tensor([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": pose.tolist()})
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    sizes = {"w": camera.width, "h": camera.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    (folder / "transforms.json").write_text(json.dumps({**sizes, **lens, "frames": frames}))
    return folder


@pytest.mark.parametrize(
    ("numbers", "fisheye", "named"),
    [
        (BROWN[:4], False, dict(zip(("k1", "k2", "p1", "p2"), BROWN, strict=False))),
        (BROWN, False, dict(zip(("k1", "k2", "p1", "p2", "k3"), BROWN, strict=True))),
        (FISHEYE, True, dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True))),
    ],
)
def test_images_are_undistorted_as_those_of_files(tmp_path, numbers, fisheye, named):
    camera = Camera([[60, 0, 39], [0, 61, 31], [0, 0, 1]], CAMERAS[1].viewmat, 80, 60)
    colors = np.random.default_rng(2).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    lens = named | {"camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV"}
    read = load_scene(written(tmp_path / "scene", camera, colors, lens)).views[0].images[RGB]
    made = Scene.from_arrays([camera], rgb=[colors], distortion=numbers, fisheye=fisheye)
    found = made.train[0].images[RGB]
    assert not torch.allclose(found.camera.K, camera.K, atol=0.1)
    torch.testing.assert_close(found.camera.K, read.camera.K)
    torch.testing.assert_close(found.camera.viewmat, read.camera.viewmat, rtol=0, atol=1e-6)
    (one, other) = found.load(), read.load()
    one_level = 1.01 / 255
    torch.testing.assert_close(one.values, other.values, rtol=0, atol=one_level)
    assert (one.valid is None) == (other.valid is None)
    assert one.valid is None or torch.equal(one.valid, other.valid)


def test_a_lens_moves_what_a_straight_line_of_the_world_shows_back_onto_a_line():
    camera = Camera([[70, 0, 40], [0, 70, 30], [0, 0, 1]], np.eye(4), 80, 60)
    x, y = np.meshgrid((np.arange(80) + 0.5 - 40) / 70, (np.arange(60) + 0.5 - 30) / 70)
    u, _ = Lens(80, 60, 70, 70, 40, 30, (-0.3, 0.0, 0.0, 0.0)).undistort(x, y)
    celsius = 20 + 10 * u
    made = Scene.from_arrays([camera], celsius=[celsius], distortion=np.array([[-0.3, 0, 0, 0, 0]]))
    photo = made.train[0].images[THERMAL]
    values = made.temperature.to_celsius(photo.load().values[..., 0]).numpy()
    (fx, _, cx), *_ = photo.camera.K.tolist()
    expected = np.broadcast_to(20 + 10 * (np.arange(80) + 0.5 - cx) / fx, (60, 80))
    np.testing.assert_allclose(values, expected, atol=2e-2)
    assert np.ptp(celsius[:, 5]) > 0.3, "the line was bent before"


def test_each_view_and_each_modality_may_have_a_lens_of_its_own():
    views = [None, BROWN[:4], BROWN]
    made = Scene.from_arrays(
        CAMERAS[:3],
        rgb=RGB_IMAGES[:3],
        celsius=CELSIUS[:3],
        thermal_cameras=CAMERAS[:3],
        distortion=views,
        thermal_distortion=np.array(FISHEYE).reshape(4, 1),
        thermal_fisheye=True,
        eval_every=0,
    )
    kept = [torch.equal(view.cameras[RGB].K, CAMERA.K) for view in made.train]
    assert kept == [True, False, False]
    assert not any(torch.equal(view.cameras[THERMAL].K, CAMERA.K) for view in made.train)
    shared = Scene.from_arrays(
        CAMERAS[:3], rgb=RGB_IMAGES[:3], celsius=CELSIUS[:3], distortion=BROWN, eval_every=0
    )
    assert all(view.shares_camera(RGB, THERMAL) for view in shared.train)


def test_pixels_that_are_not_known_stay_unknown_in_undistorted_images():
    celsius = CELSIUS[:1].copy()
    celsius[0, 3, 4] = np.nan
    made = Scene.from_arrays(CAMERAS[:1], celsius=celsius, distortion=BROWN)
    pixels = made.train[0].images[THERMAL].load()
    assert pixels.valid is not None
    assert not pixels.valid.all()
    assert pixels.values.isfinite().all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"distortion": [0.1, 0.2, 0.3]}, r"distortion must have 4 or 5 .* not 3"),
        ({"distortion": np.zeros((1, 8))}, r"distortion must have 4 or 5 .* not 8"),
        ({"distortion": BROWN, "fisheye": True}, r"4 of a fisheye .* not 5"),
        ({"distortion": [BROWN] * 2}, r"9 cameras, but 2 lenses"),
        ({"distortion": [np.nan, 0, 0, 0]}, "fold"),
        ({"distortion": [-99.0, 0, 0, 0]}, "fold"),
        ({"distortion": 0.1}, "list of coefficients"),
        ({"distortion": "BROWN"}, "numbers"),
        ({"distortion": [[0.1]] * 9}, r"distortion must have 4 or 5 .* not 1"),
        ({"fisheye": True}, "fisheye .*give distortion"),
        ({"thermal_distortion": BROWN}, "thermal_distortion .*thermal_cameras"),
        ({"thermal_fisheye": True}, "thermal_fisheye .*thermal_cameras"),
        ({"thermal_fisheye": True, "thermal_cameras": CAMERAS}, "fisheye .*thermal_distortion"),
    ],
)
def test_a_lens_that_cannot_be_is_refused_in_one_line(options, message):
    with pytest.raises(ValueError, match=message) as refused:
        Scene.from_arrays(CAMERAS, rgb=RGB_IMAGES, **options)
    assert "\n" not in str(refused.value)


def test_every_nth_view_is_held_out():
    made = Scene.from_arrays(CAMERAS, rgb=RGB_IMAGES, eval_every=4)
    assert [view.name for view in made.eval] == ["00000", "00004", "00008"]
    assert len(made.train) == 6
    single = Scene.from_arrays(CAMERAS[:1], rgb=RGB_IMAGES[:1])
    assert (len(single.train), single.eval) == (1, ())


def test_temperatures_are_scaled_to_whole_degrees_around_them():
    made = Scene.from_arrays(CAMERAS, celsius=CELSIUS)
    assert made.temperature == TemperatureRange(12, 32)
    values = made.train[0].images[THERMAL].load().values[..., 0]
    np.testing.assert_allclose(made.temperature.to_celsius(values), CELSIUS[1], atol=1e-4)
    flat = Scene.from_arrays(CAMERAS[:1], celsius=np.full((1, 6, 8), 20.0))
    assert flat.temperature == TemperatureRange(20, 21)


def test_unknown_temperatures_are_not_valid():
    celsius = CELSIUS[:1].copy()
    celsius[0, 2, 3], celsius[0, 0, 0] = np.nan, np.inf
    pixels = Scene.from_arrays(CAMERAS[:1], celsius=celsius).train[0].images[THERMAL].load()
    assert pixels.values.isfinite().all()
    assert (~pixels.valid).nonzero().tolist() == [[0, 0], [2, 3]]


@pytest.mark.parametrize("scale", [1, 1 / 255], ids=["bytes", "shares"])
def test_masked_pixels_are_not_valid(scale):
    mask = np.zeros((1, 6, 8), bool)
    mask[0, 2, 3] = True
    colors = RGB_IMAGES[:1] if scale == 1 else RGB_IMAGES[:1] * scale
    made = Scene.from_arrays(
        CAMERAS[:1],
        rgb=np.ma.array(colors, mask=np.repeat(mask[..., None], 3, axis=3)),
        celsius=np.ma.array(CELSIUS[:1], mask=mask),
    )
    for modality in (RGB, THERMAL):
        pixels = made.train[0].images[modality].load()
        assert pixels.values.isfinite().all()
        assert (~pixels.valid).nonzero().tolist() == [[2, 3]]
    unmasked = Scene.from_arrays(CAMERAS[:1], rgb=RGB_IMAGES[:1]).train[0].images[RGB].load()
    found = made.train[0].images[RGB].load()
    torch.testing.assert_close(found.values[found.valid], unmasked.values[found.valid])


def test_colours_that_are_not_known_are_not_valid_in_held_out_views_too():
    rgb = RGB_IMAGES / 255
    rgb[:, :3] = np.nan
    made = Scene.from_arrays(CAMERAS, rgb=rgb)
    for view in made.views:
        pixels = view.images[RGB].load()
        assert pixels.values.isfinite().all()
        assert not pixels.valid[:3].any()
        assert pixels.valid[3:].all()


def test_images_without_a_known_pixel_are_none():
    celsius, rgb = CELSIUS.copy(), RGB_IMAGES / 255
    celsius[3], rgb[5] = np.nan, np.nan
    made = Scene.from_arrays(CAMERAS, rgb=rgb, celsius=celsius, eval_every=0)
    images = [tuple(view.images) for view in made.train]
    assert images[3:6] == [(RGB,), (RGB, THERMAL), (THERMAL,)]
    with pytest.raises(SceneError, match="view 5 has"):
        Scene.from_arrays(CAMERAS, rgb=rgb)


def test_temperatures_that_look_like_kelvin_are_doubted_and_kept():
    with pytest.warns(MrgsWarning, match=r" 285\.\d* .*304\.\d*, .*kelvin") as caught:
        made = Scene.from_arrays(CAMERAS, celsius=CELSIUS + 273.15)
    assert made.temperature == TemperatureRange(285, 305)
    assert caught[0].filename == __file__
    Scene.from_arrays(CAMERAS, celsius=CELSIUS * 30)  # a furnace


@pytest.mark.parametrize("dtype", [">f4", np.int16, np.uint16, np.uint64, np.longdouble])
def test_temperatures_of_every_type_of_number(dtype):
    made = Scene.from_arrays(CAMERAS, celsius=CELSIUS.astype(dtype), eval_every=0)
    values = made.train[0].images[THERMAL].load().values[..., 0]
    expected = CELSIUS[0].astype(dtype).astype(np.float32)
    np.testing.assert_allclose(made.temperature.to_celsius(values), expected, atol=1e-4)


def test_cameras_and_images_may_come_from_generators_and_none_is_nothing():
    made = Scene.from_arrays(
        (each for each in CAMERAS),
        rgb=(each for each in RGB_IMAGES),
        celsius=(each for each in CELSIUS),
        thermal_cameras=iter(CAMERAS),
    )
    assert repr(made) == repr(Scene.from_arrays(CAMERAS, rgb=RGB_IMAGES, celsius=CELSIUS))
    nothing = {"celsius": None, "thermal_cameras": None, "points": None, "colors": None}
    assert Scene.from_arrays(CAMERAS, rgb=RGB_IMAGES, **nothing).modalities == (RGB,)
    assert Scene.from_arrays(CAMERAS, rgb=None, celsius=CELSIUS).modalities == (THERMAL,)


def test_colours_of_points_may_be_bytes_and_are_grey_where_they_are_not_known():
    def colors_of(colors) -> list:
        points = [[0, 0, 0], [1, 1, 1], [1e30, 0, 0]]
        return Scene.from_arrays(
            CAMERAS, rgb=RGB_IMAGES, points=points, colors=colors
        ).points.colors.tolist()

    assert colors_of(np.array([[255, 0, 255]] * 3, np.uint8)) == [[1, 0, 1]] * 2
    assert colors_of([[1, 0, np.nan]] * 3) == [[1, 0, 0.5]] * 2


def test_views_may_lack_an_image_and_thermal_cameras_differ():
    thermal = [camera.resized(4, 3) for camera in CAMERAS[:2]]
    made = Scene.from_arrays(
        CAMERAS[:2],
        rgb=[RGB_IMAGES[0], None],
        celsius=[None, CELSIUS[1, :3, :4]],
        thermal_cameras=thermal,
        eval_every=0,
    )
    assert [tuple(view.images) for view in made.train] == [(RGB,), (THERMAL,)]
    assert made.train[1].camera is thermal[1]


def test_start_points_are_drawn_where_none_are_given():
    drawn = Scene.from_arrays(CAMERAS, rgb=RGB_IMAGES, seed=3).points
    assert len(drawn) == RANDOM_POINTS
    again = Scene.from_arrays(CAMERAS, rgb=RGB_IMAGES, seed=3).points
    assert torch.equal(drawn.positions, again.positions)
    given = Scene.from_arrays(CAMERAS, rgb=RGB_IMAGES, points=[[0, 0, 0], [np.nan, 0, 0]]).points
    assert (given.positions.tolist(), given.colors.tolist()) == ([[0, 0, 0]], [[0.5] * 3])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cameras": []}, "at least one view"),
        ({"rgb": ()}, "view 0 has"),
        ({"celsius": np.full((9, 6, 8), np.nan)}, "no thermal image"),
    ],
)
def test_what_is_no_scene(arguments, message):
    with pytest.raises(SceneError, match=message):
        Scene.from_arrays(**({"cameras": CAMERAS} | arguments))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rgb": RGB_IMAGES[:5]}, "9 cameras, .*5 images"),
        ({"rgb": RGB_IMAGES, "thermal_cameras": CAMERAS[:2]}, "9 cameras, .*2 thermal"),
        ({"rgb": RGB_IMAGES[:, :5]}, r"rgb\[0\] .*\[6, 8, 3\], not \[5,"),
        ({"rgb": RGB_IMAGES[..., 0]}, r"rgb\[0\] .*any, 3\], not \[6, 8\]"),
        *(
            ({"rgb": RGB_IMAGES.astype(dtype)}, r"rgb\[0\] .*\d: give uint8")
            for dtype in (np.float32, np.int64, np.uint16, np.float64)
        ),
        ({"rgb": RGB_IMAGES.tolist()}, r"rgb\[0\] .*\d: give uint8"),
        ({"rgb": RGB_IMAGES / 255 - 0.5}, r"rgb\[0\] .*-0\.5 .*uint8"),
        ({"rgb": RGB_IMAGES * 1j}, r"rgb\[0\] .*complex"),
        ({"rgb": 3}, "rgb .*list of images"),
        ({"celsius": CELSIUS[..., None]}, r"celsius\[0\] .*\[any, any\]"),
        ({"celsius": CELSIUS[:, :5]}, r"celsius\[0\] .*\[6, 8\], not \[5,"),
        ({"celsius": CELSIUS * 1j}, r"celsius\[0\] .*complex"),
        (
            {"celsius": np.where(CELSIUS > 31, 1e30, CELSIUS)},
            r"celsius\[0\] .* 12\.\d* to 1e\+30: ",
        ),
        ({"celsius": (CELSIUS * 400).astype(np.uint16)}, r"celsius\[0\] .*raw counts"),
        ({"celsius": [[[1, 2], [3]]]}, r"celsius\[0\] .*of numbers"),
        ({"rgb": RGB_IMAGES, "points": [[0, 1]]}, r"points .*\[any, 3\]"),
        (
            {"rgb": RGB_IMAGES, "points": [[0, 1, 2]], "colors": [[0, 0, 0], [1, 1, 1]]},
            "1 points, .*2 colors",
        ),
        ({"rgb": RGB_IMAGES, "points": (row for row in "a")}, "points .*of numbers"),
        (
            {"rgb": RGB_IMAGES, "points": [[0, 1, 2]], "colors": [[0, 128, 255]]},
            "colors .* 255: give uint8",
        ),
        ({"rgb": RGB_IMAGES, "eval_every": 1}, "eval_every .*not 1"),
        ({"rgb": RGB_IMAGES, "eval_every": -1}, "eval_every .*not -1"),
        ({"rgb": RGB_IMAGES, "eval_every": 2.0}, r"eval_every .*not 2\.0"),
    ],
)
def test_arrays_that_do_not_fit(arguments, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        Scene.from_arrays(CAMERAS, **arguments)


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        (
            np.tile(np.eye(4), (9, 1, 1)),
            r"cameras\[0\] .*ndarray",
        ),
        (CAMERA, "cameras must be a list"),
    ],
)
def test_what_is_no_list_of_cameras(cameras, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        Scene.from_arrays(cameras, rgb=RGB_IMAGES)
    with unchecked(), pytest.raises(ValueError, match=f"thermal_{message}"):
        Scene.from_arrays(CAMERAS, rgb=RGB_IMAGES, thermal_cameras=cameras)


def test_a_scene_and_a_view_are_short_lines():
    made = Scene.from_arrays(CAMERAS, rgb=RGB_IMAGES, celsius=CELSIUS, name="oven")
    assert repr(made) == (
        "Scene('oven', 7 training + 2 evaluation views, RGB + thermal, 12 to 32 °C, 20,000 points)"
    )
    assert repr(made.train[0]).startswith("View('00001', rgb 8×6, ")


def test_reversed_channels_and_read_only_arrays_are_taken():
    reversed_channels = np.broadcast_to(RGB_IMAGES[:1], (1, 6, 8, 3))[..., ::-1]
    assert not reversed_channels.flags.writeable
    values = Scene.from_arrays(CAMERAS[:1], rgb=reversed_channels).train[0].images[RGB].load()
    np.testing.assert_allclose(values.values * 255, RGB_IMAGES[0, ..., ::-1], atol=1e-4)
