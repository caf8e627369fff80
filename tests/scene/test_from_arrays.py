"""A scene from arrays is the scene that the same images make in a folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.data import load_scene
from mrgs.errors import SceneError
from mrgs.scene import RGB, THERMAL, Camera, Scene, TemperatureRange
from mrgs.scene.point_cloud import RANDOM_POINTS

CAMERA = Camera.from_fov(8, 6, 60)
CAMERAS = [CAMERA.look_at([3 * np.cos(a), 3 * np.sin(a), 1], [0, 0, 0]) for a in range(9)]
RGB_IMAGES = np.random.default_rng(0).integers(0, 256, (9, 6, 8, 3), dtype=np.uint8)
CELSIUS = np.random.default_rng(1).uniform(12.3, 31.7, (9, 6, 8)).astype(np.float32)


def test_it_is_the_scene_of_the_folder(small_scene: Path):
    folder = load_scene(small_scene)
    views = sorted((*folder.train, *folder.eval), key=lambda view: view.name[-5:])
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
        ({"rgb": ()}, "view 0 has no image"),
        ({"celsius": np.full((9, 6, 8), np.nan)}, "no thermal image has a finite temperature"),
    ],
)
def test_what_is_no_scene(arguments, message):
    with pytest.raises(SceneError, match=message):
        Scene.from_arrays(**({"cameras": CAMERAS} | arguments))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rgb": RGB_IMAGES[:5]}, "9 cameras, but 5 images in rgb"),
        ({"rgb": RGB_IMAGES, "thermal_cameras": CAMERAS[:2]}, "9 cameras, but 2 thermal cameras"),
        ({"rgb": RGB_IMAGES[:, :5]}, r"rgb\[0\] must have shape \[6, 8, 3\], not \[5, 8, 3\]"),
        ({"celsius": CELSIUS[..., None]}, r"celsius must have shape \[any, any\]"),
        ({"rgb": RGB_IMAGES, "points": [[0, 1]]}, r"points must have shape \[any, 3\]"),
        (
            {"rgb": RGB_IMAGES, "points": [[0, 1, 2]], "colors": [[0, 0, 0], [1, 1, 1]]},
            r"colors must have shape \[1, 3\], not \[2, 3\]",
        ),
    ],
)
def test_arrays_that_do_not_fit(arguments, message):
    with pytest.raises(ValueError, match=message):
        Scene.from_arrays(CAMERAS, **arguments)


def test_a_scene_and_a_view_are_short_lines():
    made = Scene.from_arrays(CAMERAS, rgb=RGB_IMAGES, celsius=CELSIUS, name="oven")
    assert repr(made) == (
        "Scene('oven', 7 training + 2 evaluation views, RGB + thermal, 12 to 32 °C, 20,000 points)"
    )
    assert repr(made.train[0]) == "View('00001', rgb 8×6, thermal 8×6)"


def test_reversed_channels_and_read_only_arrays_are_taken():
    reversed_channels = np.broadcast_to(RGB_IMAGES[:1], (1, 6, 8, 3))[..., ::-1]
    assert not reversed_channels.flags.writeable
    values = Scene.from_arrays(CAMERAS[:1], rgb=reversed_channels).train[0].images[RGB].load()
    np.testing.assert_allclose(values.values * 255, RGB_IMAGES[0, ..., ::-1], atol=1e-4)
