from __future__ import annotations

import numpy as np
import pytest

from mrgs.pictures.palette import palette_table
from mrgs.scene import THERMAL, SceneBounds
from mrgs.viewer.painting import (
    ISOTHERM_COLOR,
    ISOTHERM_ON_RAINBOW,
    NO_SURFACE_COLOR,
    blend,
    compose,
    measure_scales,
    paint,
    split,
)
from mrgs.viewer.panes import Pane, PaneImages, difference
from mrgs.viewer.settings import Settings
from tests.helpers.panes import RANGE, SIZE, heat, thermal_pane


def painted(camera, **choices) -> np.ndarray:
    pane, settings = thermal_pane(camera), Settings(**choices)
    return paint(pane, heat(), measure_scales([pane], [heat()], settings, RANGE), settings)


def test_the_automatic_range_follows_what_is_seen(camera):
    scale = measure_scales([thermal_pane(camera)], [heat()], Settings(), RANGE)[THERMAL]
    assert (scale.low, scale.high, scale.unit) == (10, 30, "°C")


def test_empty_pixels_do_not_count_for_the_range(camera):
    fields = heat()
    fields.solid[:, 80:] = False
    scale = measure_scales([thermal_pane(camera)], [fields], Settings(), RANGE)[THERMAL]
    assert scale.high < 20.1


def test_the_range_can_be_set_by_hand(camera):
    image = painted(camera, limits={THERMAL: (20.0, 40.0)}, palette="iron")
    table = palette_table("iron")
    assert (image[0, 0] == table[0]).all()
    assert (image[0, -1] == table[128]).all()


def test_the_isotherm_marks_the_band_and_nothing_else(camera):
    plain, marked = painted(camera), painted(camera, isotherm=(25.0, 15.0))
    band = (heat().images[THERMAL] >= 15) & (heat().images[THERMAL] <= 25)
    assert (marked[band] == ISOTHERM_COLOR).all()
    assert (marked[~band] == plain[~band]).all()
    assert (
        painted(camera, isotherm=(15.0, 25.0), palette="rainbow")[band] == ISOTHERM_ON_RAINBOW
    ).all()


def test_what_the_model_does_not_cover_has_no_temperature(camera):
    pane, fields = thermal_pane(camera), heat()
    fields.solid[:60] = False
    settings = Settings(isotherm=(10.0, 30.0))
    image = paint(pane, fields, measure_scales([pane], [fields], settings, RANGE), settings)
    assert (image[:60] == NO_SURFACE_COLOR).all()
    assert (image[60:] == ISOTHERM_COLOR).all()


def test_near_is_light(camera):
    pane, fields = Pane("depth", (), camera), heat()
    fields.depth[:] = np.linspace(1, 5, 160)
    image = paint(
        pane,
        fields,
        measure_scales([pane], [fields], Settings(), RANGE),
        Settings(),
    )
    assert image[0, 0].sum() > image[0, -1].sum()


def test_the_sky_does_not_count_on_the_scale_of_the_depth(camera):
    pane, fields = Pane("depth", (), camera), heat()
    fields.depth[:, :80] = 900.0
    ball = SceneBounds(camera.position, 10.0)
    assert measure_scales([pane], [fields], Settings(), RANGE)["depth"].low == 900
    scales = measure_scales([pane], [fields], Settings(), RANGE, ball)
    assert scales["depth"].low < 4
    image = paint(pane, fields, scales, Settings())
    assert (image[:, :80] == palette_table("depth")[0]).all()


def test_the_slider_blends_and_splits():
    dark, light = np.full((4, 10, 3), 10, np.uint8), np.full((4, 10, 3), 210, np.uint8)
    assert (blend(dark, light, 0.25) == 60).all()
    assert (blend(dark, light, 0) == dark).all()
    assert (blend(dark, light, 1) == light).all()
    row = split(dark, light, 0.3)[0, :, 0]
    assert row.tolist() == [10] * 6 + [255, 255] + [210] * 2
    assert (split(dark, light, 0) == dark).all()
    assert (split(dark, light, 1) == light).all()


def test_the_difference_is_model_minus_photo():
    model = heat()
    photo = PaneImages({THERMAL: heat().images[THERMAL] - 0.5}, None, np.ones((120, 160), bool))
    photo.solid[0, 0] = False
    fields = difference(THERMAL, model, photo)
    assert np.isnan(fields.images[THERMAL][0, 0])
    np.testing.assert_allclose(fields.images[THERMAL][1:], 0.5)


def test_the_scale_of_a_difference_is_even_about_zero(camera):
    pane = thermal_pane(camera, "difference")
    values = np.linspace(-1, 3, 19200, dtype=np.float32).reshape(120, 160)
    fields = PaneImages({THERMAL: values}, None, heat().solid)
    scale = measure_scales([pane], [fields], Settings(), RANGE)["difference"]
    assert scale.low == -scale.high
    assert scale.high == pytest.approx(3, abs=0.05)


def test_the_picture_itself_has_no_marks_and_no_scale(camera):
    pane, settings = thermal_pane(camera), Settings(palette="grey")
    scales = measure_scales([pane], [heat()], settings, RANGE)
    picture = compose(SIZE, [pane], [heat()], scales, settings)
    assert (picture == picture[:1]).all(), "each row of the ramp is the same"


def test_a_coarse_rendering_is_stretched_to_its_pane(camera):
    whole = heat()
    small = PaneImages(
        {THERMAL: whole.images[THERMAL][::4, ::4]}, whole.depth[::4, ::4], whole.solid[::4, ::4]
    )
    pane, settings = thermal_pane(camera), Settings()
    image = compose(
        SIZE, [pane], [small], measure_scales([pane], [small], settings, RANGE), settings
    )
    assert image.shape == (120, 160, 3)
