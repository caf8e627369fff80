from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mrgs.errors import ConfigError, RunError
from mrgs.export.splats import (
    require_exportable,
    shaded_splats,
    shown_temperatures,
    temperature_name,
    thermal_scale,
    thermal_splats,
)
from mrgs.pictures.palette import palette_table
from mrgs.scene import RGB, THERMAL
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
