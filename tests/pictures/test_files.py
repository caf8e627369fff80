from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.data.images import read_float_tiff
from mrgs.errors import RunError
from mrgs.pictures.drawing import Scale
from mrgs.pictures.files import (
    to_rgb8,
    with_scale_bar,
    write_depth_png,
    write_float_tiff,
    write_png,
    write_rendering,
)
from mrgs.pictures.palette import palette_table
from mrgs.scene import RGB, THERMAL, Blend, Rendering, SceneBounds, View
from tests.helpers.gaussians import NEAR_INFRARED
from tests.helpers.views import CELSIUS, ramp_view, render_with_error, rendering_of


def rendering() -> Rendering:
    generator = torch.Generator().manual_seed(3)
    rgb, thermal = (
        torch.rand(12, 16, 3, generator=generator),
        torch.rand(9, 12, 1, generator=generator) * 1.4 - 0.2,
    )
    depth = torch.rand(9, 12, generator=generator)
    return Rendering(
        {
            RGB: Blend(rgb, torch.full((12, 16), 2.0), torch.ones(12, 16)),
            THERMAL: Blend(thermal, depth, torch.ones(9, 12)),
        }
    )


def test_a_float_tiff_returns_every_bit(tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(20, 300, (7, 5)).astype(np.float32)
    values[0, 0] = np.nextafter(np.float32(36.6), np.float32(40))
    path = write_float_tiff(tmp_path / "t.tiff", values, "temperature, degrees Celsius")
    np.testing.assert_array_equal(read_float_tiff(path), values)
    with Image.open(path) as image:
        assert image.tag_v2[270] == "temperature, degrees Celsius"


def test_rgb_is_clamped_and_rounded(tmp_path: Path) -> None:
    colors = torch.tensor([[[-0.5, 0.5, 1.5], [float("nan"), 0.2, 1.0]]], requires_grad=True)
    assert to_rgb8(colors).tolist() == [[[0, 128, 255], [0, 51, 255]]]
    with Image.open(write_png(tmp_path / "c.png", to_rgb8(colors))) as image:
        np.testing.assert_array_equal(np.asarray(image), to_rgb8(colors))


def test_all_images_of_a_view_in_celsius(tmp_path: Path) -> None:
    shown = rendering()
    paths = write_rendering(tmp_path, ramp_view("v1"), shown, CELSIUS)
    names = {str(path.relative_to(tmp_path)) for path in paths}
    assert names == {
        "rgb/v1.png",
        "thermal/v1.png",
        "temperature_c/v1.tiff",
        "depth_rgb/v1.tiff",
        "depth_rgb/v1.png",
        "depth_thermal/v1.tiff",
        "depth_thermal/v1.png",
    }
    assert all(path.is_file() for path in paths)
    expected = CELSIUS.to_celsius(shown[THERMAL].image[..., 0]).numpy()
    np.testing.assert_array_equal(read_float_tiff(tmp_path / "temperature_c/v1.tiff"), expected)
    assert expected.max() > CELSIUS.max_c  # not clamped


def test_without_celsius_the_file_says_so(tmp_path: Path) -> None:
    shown = rendering()
    write_rendering(tmp_path, ramp_view("v1"), shown, None)
    assert not (tmp_path / "temperature_c").exists()
    path = tmp_path / "thermal_normalised" / "v1.tiff"
    np.testing.assert_array_equal(read_float_tiff(path), shown[THERMAL].image[..., 0].numpy())
    with Image.open(path) as image:
        assert "normalised" in image.tag_v2[270]


def test_what_the_model_lacks_is_left_out(tmp_path: Path) -> None:
    paths = write_rendering(
        tmp_path,
        ramp_view("v1"),
        rendering_of({THERMAL: rendering()[THERMAL].image}),
        CELSIUS,
    )
    assert {path.parent.name for path in paths} == {"temperature_c", "thermal"}


def test_a_third_modality_is_a_grey_picture(tmp_path: Path) -> None:
    view = ramp_view("v1", rgb=False, thermal=False, nir=True)
    paths = write_rendering(tmp_path, view, render_with_error(view), CELSIUS)
    assert [str(path.relative_to(tmp_path)) for path in paths] == [
        "nir/v1.png",
        "depth_nir/v1.tiff",
        "depth_nir/v1.png",
    ]
    with Image.open(paths[0]) as image:
        pixels = np.asarray(image)
    expected = np.rint((view.images[NEAR_INFRARED].load().values.numpy() + 0.01) * 255)
    np.testing.assert_array_equal(pixels, np.repeat(expected, 3, axis=2))


def test_the_map_keeps_its_pixels_beside_the_bar(tmp_path: Path) -> None:
    values = np.linspace(10, 30, 60 * 80, dtype=np.float32).reshape(60, 80)
    scale = Scale("iron", 10.0, 30.0, "°C")
    path = write_png(tmp_path / "t.png", with_scale_bar(values, scale))
    with Image.open(path) as image:
        pixels = np.asarray(image)
    assert pixels.shape[0] == 60
    assert pixels.shape[1] > 80
    np.testing.assert_array_equal(pixels[[0, -1], [0, 79]], palette_table("iron")[[0, -1]])


def test_near_is_light_in_a_depth_picture(tmp_path: Path) -> None:
    depth = np.linspace(1, 9, 400, dtype=np.float32).reshape(20, 20)
    with Image.open(write_depth_png(tmp_path / "d.png", depth)) as image:
        pixels = np.asarray(image).astype(int).sum(axis=2)
    assert pixels[0, 0] > pixels[-1, -1] + 300


def test_the_sky_does_not_count_in_a_depth_picture_but_is_in_the_file(tmp_path: Path) -> None:
    shown, view = rendering(), ramp_view("v1")
    shown[RGB].depth[:6] = 900.0
    shown[RGB].depth[6:9] = 2.5
    camera = replace(view.images[RGB].camera, width=16, height=12)
    view = View("v1", {RGB: replace(view.images[RGB], camera=camera)})
    write_rendering(tmp_path, view, shown, None, ball=SceneBounds(camera.position, 10.0))
    assert read_float_tiff(tmp_path / "depth_rgb/v1.tiff").max() == 900
    with Image.open(tmp_path / "depth_rgb/v1.png") as image:
        pixels = np.asarray(image)
    np.testing.assert_array_equal(pixels[[0, 7, 11], 5], palette_table("depth")[[0, 0, -1]])


def test_a_place_that_cannot_be_written_is_a_run_error(tmp_path: Path) -> None:
    (tmp_path / "rgb").write_text("")
    with pytest.raises(RunError, match=r"v1\.png cannot"):
        write_rendering(tmp_path, ramp_view("v1"), rendering(), None)
