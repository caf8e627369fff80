from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mrgs.data import load_scene
from mrgs.scene import RGB
from mrgs_thermonerf.rays import contract, frame_of


@given(st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3))
def test_all_of_space_falls_into_the_unit_cube(position):
    contracted = contract(torch.tensor([position], dtype=torch.float64))
    assert ((contracted >= 0) & (contracted <= 1)).all()


def test_the_inner_cube_is_kept_and_the_outer_space_is_bent():
    positions = torch.tensor(
        [[0.0, 0, 0], [1, -1, 0.5], [2, 0, 0], [1e9, 0, 0]], dtype=torch.float64
    )
    expected = torch.tensor(
        [[0.5, 0.5, 0.5], [0.75, 0.25, 0.625], [0.875, 0.5, 0.5], [1, 0.5, 0.5]]
    )
    torch.testing.assert_close(contract(positions), expected.double())


def test_contraction_is_continuous_and_outwards():
    line = (
        torch.linspace(0, 5, 1001, dtype=torch.float64)[:, None]
        * torch.tensor([[0.3, -1.0, 0.5]]).double()
    )
    steps = contract(line).diff(dim=0)
    assert (steps[:, 1] < 0).all()
    assert steps.abs().max() < 0.002


def test_the_frame_lies_about_the_start_points(small_scene):
    scene = load_scene(small_scene)
    frame = frame_of(scene)
    inside = frame.normalised(scene.points.positions.double()).abs().amax(dim=1) <= 1
    assert 0.4 <= inside.double().mean() <= 0.6
    distance = scene.train[0].images[RGB].camera.position.norm().item()
    assert frame.middle * frame.radius == pytest.approx(distance, rel=0.1)
    assert 0 < frame.near < frame.middle < frame.far
