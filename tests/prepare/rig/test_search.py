from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, map_coordinates

from mrgs.prepare.rig.images import InverseDepth, Plane, ReducedPair
from mrgs.prepare.rig.search import first_guess
from mrgs.scene import Camera
from mrgs.scene.camera import focal_length

WIDTH, HEIGHT, FOCAL = 320, 240, 260.0
CAMERA = Camera(
    torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64),
    torch.eye(4, dtype=torch.float64),
    WIDTH,
    HEIGHT,
)


def pairs(
    focal_widths: float, turn_deg: float, shift_widths: tuple[float, float]
) -> list[ReducedPair]:
    """Three photos of blots, and their inverted images, scaled, turned and shifted, 160×120 px."""
    rng = np.random.default_rng(0)
    made = []
    for index in range(3):
        photo = (gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 5) > 0).astype(np.float64)
        photo = gaussian_filter(photo, 1.0)
        x, y = np.meshgrid(np.arange(160) + 0.5 - 80, np.arange(120) + 0.5 - 60)
        x, y = x - 160 * shift_widths[0], y - 160 * shift_widths[1]
        zoom = FOCAL / (focal_widths * 160)
        cos, sin = zoom * np.cos(np.radians(turn_deg)), zoom * np.sin(np.radians(turn_deg))
        u, v = cos * x - sin * y + WIDTH / 2, sin * x + cos * y + HEIGHT / 2
        thermal = -map_coordinates(photo, [v - 0.5, u - 0.5], order=1, mode="reflect")
        depth = InverseDepth(np.full((60, 80), 0.2), 0.2)
        planes = [Plane(values.astype(np.float32)) for values in (photo, thermal)]
        made.append(ReducedPair(f"pair_{index}", planes[0], CAMERA, depth, planes[1]))
    return made


@pytest.mark.parametrize(
    ("focal", "turn_deg", "shift"),
    [
        pytest.param(1.1, 0.0, (0.05, -0.04), marks=pytest.mark.slow),
        pytest.param(1.4, 3.0, (-0.1, 0.02), marks=pytest.mark.slow),
        (0.9, -3.0, (0.0, 0.08)),
    ],
)
def test_scale_turn_and_shift_are_found(focal, turn_deg, shift):
    field_of_view_deg = float(np.degrees(2 * np.arctan(0.5 / focal))) * 1.04
    found = first_guess(pairs(focal, turn_deg, shift), field_of_view_deg)
    assert found.best.focal_widths == pytest.approx(focal, rel=0.03)
    assert found.best.turn_deg == pytest.approx(turn_deg, abs=1)
    assert found.best.shift_widths == pytest.approx(shift, abs=0.02)
    assert found.best.score > 1.5 * found.chance


@pytest.mark.slow
def test_an_unknown_field_of_view_is_found():
    found = first_guess(pairs(1.2, 0.0, (0.03, 0.0))[:2], None)
    assert found.best.focal_widths == pytest.approx(1.2, rel=0.03)
    assert found.best.score > 1.5 * found.chance


@pytest.mark.slow
@pytest.mark.parametrize("turn_deg", [90.0, -90.0, 180.0, 87.0])
def test_quarter_turns_are_found(turn_deg):
    """As where only one of the cameras notes how they were held."""
    found = first_guess(pairs(1.1, turn_deg, (0.05, -0.04)), 48.0)
    assert found.best.focal_widths == pytest.approx(1.1, rel=0.03)
    assert found.best.turn_deg == pytest.approx(turn_deg, abs=1)
    assert found.best.shift_widths == pytest.approx((0.05, -0.04), abs=0.02)
    assert found.stands_out


@pytest.mark.slow
def test_pairs_that_do_not_belong_together_stand_out_no_more_than_chance():
    right = pairs(1.1, 0.0, (0.0, 0.0))
    wrong = [
        ReducedPair(pair.name, pair.photo, pair.camera, pair.depth, other.thermal)
        for pair, other in zip(right, right[1:] + right[:1], strict=True)
    ]
    found = first_guess(wrong, 48.0)
    assert found.best.score < 0.5 * first_guess(right, 48.0).best.score
    assert not found.stands_out


def test_focal_widths():
    assert focal_length(1.0, math.radians(90.0)) == pytest.approx(0.5)


@pytest.mark.slow
def test_each_camera_that_is_tried_is_reported():
    upright, turned = [], []
    first_guess(pairs(1.1, 0.0, (0.05, -0.04)), 48.0, lambda _, *tried: upright.append(tried))
    assert upright == [(done, len(upright)) for done in range(len(upright))]
    first_guess(pairs(1.1, 90.0, (0.05, -0.04)), 48.0, lambda _, *tried: turned.append(tried))
    each = len(upright)
    planned = [1, 2, 3, 4, *(6 * [10])]  # rounds known so far: upright at two widths, then turned
    assert turned == [(done, planned[done // each] * each) for done in range(10 * each)]
