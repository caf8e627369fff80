from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mrgs_synth import outdoor
from mrgs_synth.outdoor import SnowCover

RNG = np.random.Generator
TEXTURES: dict[str, Callable[[RNG], np.ndarray]] = {
    "bricks": lambda rng: outdoor.bricks(96, 160, (12, 30), rng),
    "plaster": lambda rng: outdoor.plaster(90, 150, (226, 206, 164), rng),
    "roof_tiles": lambda rng: outdoor.roof_tiles(100, 140, 6, rng),
    "grass": lambda rng: outdoor.grass(120, 160, rng),
    "paving": lambda rng: outdoor.paving(96, 96, 24, rng),
    "leaves": lambda rng: outdoor.leaves(80, 120, rng),
}


@pytest.mark.parametrize("name", TEXTURES)
def test_textures_are_seeded_and_never_flat(name: str) -> None:
    texture = TEXTURES[name](np.random.default_rng(3))
    assert texture.dtype == np.uint8
    assert texture.astype(float).mean(axis=2).std() > 3.0
    np.testing.assert_array_equal(texture, TEXTURES[name](np.random.default_rng(3)))
    assert (texture != TEXTURES[name](np.random.default_rng(4))).any()


def test_snow_lies_for_the_eye_where_it_lies_for_the_thermometer() -> None:
    snow = SnowCover.scattered((120, 200), (-5.0, 2.0), (5.0, 8.0), 0.4, np.random.default_rng(0))
    assert snow.share.mean() == pytest.approx(0.4, abs=0.05)
    black = np.zeros((120, 200, 3), dtype=np.uint8)
    white = snow.over(black, np.random.default_rng(1)).mean(axis=2) > 170
    rows, columns = np.mgrid[0:120, 0:200]
    first = -5.0 + (columns.ravel() + 0.5) / 200 * 10.0
    second = 8.0 - (rows.ravel() + 0.5) / 120 * 6.0  # row 0 is the far edge
    covered = snow.at(first, second).reshape(120, 200)
    np.testing.assert_allclose(covered, snow.share, atol=1e-9)
    assert ((covered > 0.95) <= white).all()
    assert (white <= (covered > 0.6)).all()


def test_the_sky_is_brightest_at_its_glow_and_bluest_at_the_zenith() -> None:
    sky = outdoor.clear_sky((90.0, 30.0), np.random.default_rng(0), (90, 180))
    row, column = np.unravel_index(sky.sum(axis=2).argmax(), (90, 180))
    assert 90.0 - (row + 0.5) * 2.0 == pytest.approx(30.0, abs=3.0)
    assert (column + 0.5) * 2.0 == pytest.approx(90.0, abs=3.0)
    blue = sky[..., 2] / sky[..., 0]
    assert blue[0].mean() > 1.5 > 1.2 > blue[43, 120:].mean()  # pale above the horizon
    assert (sky > 0.0).all()
