from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mrgs.errors import ConfigError, RunError
from mrgs.evaluation.metrics import psnr
from mrgs.export.splats import (
    MEAN_OVER,
    require_exportable,
    shaded_splats,
    shown_temperatures,
    temperature_name,
    thermal_scale,
    thermal_splats,
    without_directions,
)
from mrgs.pictures.palette import palette_table
from mrgs.scene import RGB, THERMAL, Camera, evenly_spaced
from tests.helpers.exports import draw, make_baked


def test_the_colours_are_those_of_the_baked_model(baked, scene):
    camera = scene.eval[0].images[RGB].camera
    torch.testing.assert_close(
        draw(shaded_splats(baked, RGB), camera), baked.render(camera)[RGB].image, atol=1e-5, rtol=0
    )


def test_temperatures_get_the_palette_s_colours():
    baked = replace(make_baked(3), temperatures=torch.tensor([-1.0, 0.5, 2.0]))
    splats = thermal_splats(baked, thermal_scale(baked, "iron", (10.0, 30.0)))
    np.testing.assert_array_equal(splats.base_colors, palette_table("iron")[[0, 128, 255]])
    np.testing.assert_array_equal(splats.opacities, baked.opacities[THERMAL].numpy())
    assert splats.sh_degree == 0


def test_the_scale_is_the_scene_s_unless_it_is_given():
    assert (thermal_scale(make_baked()).low, thermal_scale(make_baked()).high) == (10.0, 30.0)
    assert (
        thermal_scale(make_baked(temperature=None)).low,
        thermal_scale(make_baked(temperature=None)).high,
    ) == (0, 1)
    assert thermal_scale(make_baked(), "grey", (12.5, 20)).low == 12.5


def test_celsius_cannot_be_asked_of_a_model_without():
    with pytest.raises(ConfigError, match="range in °C"):
        thermal_scale(make_baked(temperature=None), "inferno", (10.0, 30.0))
    assert temperature_name(make_baked(temperature=None)) == "temperature_normalised"


@pytest.mark.parametrize(
    "limits", [(30.0, 10.0), (10.0, 10.0), (float("nan"), 20.0), (0.0, float("inf"))]
)
def test_a_range_ascends(limits):
    with pytest.raises(ConfigError, match="ascending"):
        thermal_scale(make_baked(), "inferno", limits)


def test_shown_temperatures_are_celsius_where_they_are_known():
    normalised = shown_temperatures(make_baked(temperature=None))
    np.testing.assert_allclose(shown_temperatures(make_baked()), 10 + 20 * normalised, rtol=1e-6)


def test_an_empty_model_is_refused():
    with pytest.raises(RunError, match="no splats"):
        require_exportable(make_baked(0))


@pytest.mark.parametrize(
    "name",
    [
        "means",
        "quats",
        "scales",
        "opacity.rgb",
        "opacity.thermal",
        "sh_dc.rgb",
        "sh_rest.rgb",
        "temperatures",
    ],
)
def test_numbers_that_are_not_finite_are_refused(name):
    baked = make_baked().map_tensors(torch.clone)
    baked.tensors()[name][7] = float("nan")
    baked.tensors()[name][9] = float("inf")
    with pytest.raises(RunError, match="2 of 50"):
        require_exportable(baked)


def test_colours_without_directions_are_the_mean_over_the_cameras(scene):
    baked, cameras = make_baked(), [view.cameras[RGB] for view in scene.train]
    flat = shaded_splats(without_directions(baked, cameras), RGB)
    colors = torch.stack([baked.values(RGB, camera.position) for camera in cameras])
    base = torch.from_numpy(flat.sh[:, 0]) * 0.28209479 + 0.5
    low, high = colors.amin(0).clamp(0, 1), colors.amax(0).clamp(0, 1)
    assert ((base >= low - 1e-4) & (base <= high + 1e-4)).all()
    one = shaded_splats(without_directions(baked, cameras[:1]), RGB)
    torch.testing.assert_close(
        torch.from_numpy(one.sh[:, 0]) * 0.28209479 + 0.5, colors[0].clamp(0, 1), atol=1e-4, rtol=0
    )


def test_a_colour_without_directions_is_that_of_the_cameras_which_see_the_splat():
    baked, lens = make_baked(), Camera.from_fov(40, 30, 60)
    there = baked.means.median(dim=0).values.tolist()
    sees = [lens.look_at([there[0] + x, there[1] - 9, there[2] + 3], there) for x in (-4, 4)]
    turned_away = [lens.look_at([x, 50.0, 0.0], [x, 99.0, 0.0]) for x in range(4)]
    seen = torch.stack([each.contains(each.project(baked.means)[0]) for each in sees]).all(dim=0)
    assert seen.sum() > 10
    flat = without_directions(baked, [*turned_away, *sees]).base_values(RGB)[seen]
    expected = torch.stack([baked.values(RGB, each.position)[seen] for each in sees]).mean(dim=0)
    torch.testing.assert_close(flat, expected.clamp(0, 1), atol=4e-3, rtol=0)


def test_of_many_cameras_some_are_taken_evenly():
    baked, lens = make_baked(), Camera.from_fov(40, 30, 60)
    places = np.linspace(-9, 9, 3 * MEAN_OVER)
    cameras = [lens.look_at([x, -9.0, 3.0], [0.0, 0.0, 0.0]) for x in places]
    some = [cameras[index] for index in evenly_spaced(len(cameras), MEAN_OVER)]
    found, expected, first = (
        without_directions(baked, each).base_values(RGB)
        for each in (cameras, some, cameras[:MEAN_OVER])
    )
    assert torch.equal(found, expected)
    assert not torch.equal(found, first)


def test_colours_without_directions_beat_dropping_the_directions(baked, scene):
    cameras = [view.cameras[RGB] for view in scene.train]
    full = shaded_splats(baked, RGB)
    flat = shaded_splats(without_directions(baked, cameras), RGB)
    bounds = 0.5 / 0.28209479  # of colours between 0 and 1
    dropped = replace(full, sh=baked.sh_dc[RGB].clamp(-bounds, bounds).numpy())
    scores = [
        sum(psnr(draw(splats, camera), draw(full, camera)) for camera in cameras)
        for splats in (flat, dropped)
    ]
    assert scores[0] > scores[1] + 0.5 * len(cameras)
