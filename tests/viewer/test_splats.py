from __future__ import annotations

import numpy as np
import pytest
import torch

from mrgs.pictures.drawing import Scale
from mrgs.pictures.palette import palette_table
from mrgs.runs.baked import bake
from mrgs.scene import RGB, THERMAL
from mrgs.viewer.painting import ISOTHERM_COLOR, Scales
from mrgs.viewer.settings import Settings
from mrgs.viewer.splats import BrowserSplats, covariances, splat_colors
from tests.helpers.subjects import MODES


@pytest.fixture(scope="module")
def baked(small_run, balls):
    return bake(small_run.model, balls.train_cameras, small_run.temperature)


def test_covariances_are_those_of_the_gaussians():
    quarter_turn = torch.tensor([[2**-0.5, 0, 0, 2**-0.5]])  # about z
    found = covariances(quarter_turn, torch.tensor([[1.0, 2.0, 3.0]]))
    torch.testing.assert_close(
        found[0], torch.diag(torch.tensor([4.0, 1.0, 9.0])), atol=1e-5, rtol=0
    )


def test_temperatures_have_the_pictures_colours(baked):
    scales = Scales({THERMAL: Scale("iron", 10.0, 30.0, "°C")})
    isotherm = (0.0, baked.temperatures_c.median().item())
    settings = Settings(MODES["temperature"], "iron", isotherm=isotherm)
    colors = splat_colors(baked, settings, scales)
    hottest = int(baked.temperatures.argmax())
    expected = palette_table("iron")[round(float(baked.temperatures[hottest].clamp(0, 1)) * 255)]
    np.testing.assert_array_equal(colors[hottest], expected)
    assert (colors[int(baked.temperatures.argmin())] == ISOTHERM_COLOR).all()


def test_colours_are_the_means_over_the_directions(baked):
    colors = splat_colors(baked, Settings(MODES["colour"]), Scales())
    expected = (0.5 + 0.28209479 * baked.sh[RGB][:, 0]).clamp(0, 1) * 255
    np.testing.assert_allclose(colors, expected, atol=0.51)


def test_the_model_is_baked_once_when_it_is_wanted(baked):
    calls = []
    splats = BrowserSplats(lambda: calls.append(1) or baked)
    assert calls == []
    assert splats.baked() is splats.baked() is baked
    assert calls == [1]
