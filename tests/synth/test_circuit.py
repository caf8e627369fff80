from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mrgs_synth import circuit
from mrgs_synth.circuit import PIXELS_PER_MM, Footprint

RNG = np.random.Generator
PARTS = [
    Footprint("U1", -5.0, 2.0, (8.0, 6.0, 1.6), "four rows", 8),
    Footprint("R1", 9.0, -6.0, (3.2, 1.6, 0.8), "ends"),
    Footprint("J1", 8.0, 6.0, (6.0, 4.0, 8.0), "grid", 3),
]
TEXTURES: dict[str, Callable[[RNG], np.ndarray]] = {
    "board": lambda rng: circuit.board((40.0, 24.0), PARTS, "TITLE", rng),
    "marked": lambda rng: circuit.marked(("LM358", "A24"), (90, 60), rng),
    "cutting_mat": lambda rng: circuit.cutting_mat((60.0, 50.0), rng),
    "winding": lambda rng: circuit.winding(200, 40, 8, rng),
    "display": lambda rng: circuit.display(200, 100, "12.04", rng),
}


@pytest.mark.parametrize("name", TEXTURES)
def test_textures_are_seeded_and_never_flat(name: str) -> None:
    texture = TEXTURES[name](np.random.default_rng(3))
    assert texture.dtype == np.uint8
    assert texture.astype(float).mean(axis=2).std() > 3.0
    np.testing.assert_array_equal(texture, TEXTURES[name](np.random.default_rng(3)))
    assert (texture != TEXTURES[name](np.random.default_rng(4))).any()


def test_pads_lie_under_the_ends_of_their_part() -> None:
    texture = circuit.board((40.0, 24.0), PARTS, "", np.random.default_rng(0)).astype(int)
    row, column = round((12.0 + 6.0) * PIXELS_PER_MM), round((20.0 + 9.0) * PIXELS_PER_MM)  # of R1
    for side in (-1, 1):
        assert np.abs(texture[row, column + side * 16] - [206, 202, 186]).max() < 3  # tin
    assert np.abs(texture[row, column] - [206, 202, 186]).max() > 20


def test_footprints_in_metres() -> None:
    part = PARTS[0]
    assert part.centre_m == pytest.approx((-0.005, 0.002))
    assert part.size_m == pytest.approx((0.008, 0.006, 0.0016))
    vertices = part.body(0.01).vertices
    np.testing.assert_allclose(vertices.min(axis=0), [-0.009, -0.001, 0.01])
    np.testing.assert_allclose(vertices.max(axis=0), [-0.001, 0.005, 0.0116])
