"""The reading of grey surfaces, against cases worked out by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from mrgs.scene import Camera
from mrgs_synth.cameras import look_at, pinhole
from mrgs_synth.hits import Triangles
from mrgs_synth.radiometry import exact_temperature, mixed
from mrgs_synth.shapes import quad, sphere
from mrgs_synth.stage import Material, Solid, Stage, constant

GREY = np.full((4, 4, 3), 128, dtype=np.uint8)

HALF_AND_HALF_C = 85.18
"""300 K and 400 K in equal parts: black bodies have 51.48 and 177.76 W/(m² sr) from 7.5 to 13 µm,
and one of 358.33 K has the mean, 114.62 (trapezoids over 20,000 wavelengths)."""


def wall(name: str, y: float, celsius: float, material: Material) -> Solid:
    """A wall of 20 × 20 m that faces +y if y < 0 and −y otherwise."""
    x = 10.0 if y < 0 else -10.0
    corners = [(x, y, -10.0), (-x, y, -10.0), (-x, y, 10.0), (x, y, 10.0)]
    return Solid(name, quad(np.array(corners)), material, constant(celsius))


def ahead(position: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Camera:
    """A camera that looks along +y."""
    viewmat = look_at(np.array(position), np.array(position) + np.array([0.0, 1.0, 0.0]))
    return Camera(pinhole(20.0, 9, 7), torch.from_numpy(viewmat), 9, 7)


def reading(stage: Stage, *solids: Solid) -> np.ndarray:
    staged = dataclasses.replace(stage, solids=solids)
    return exact_temperature(ahead(), staged, Triangles.of(solids), 1)


def test_the_mean_of_the_radiances_not_of_the_temperatures() -> None:
    value = mixed(np.array([26.85]), np.array([0.5]), np.array([126.85]))
    assert value[0] == pytest.approx(HALF_AND_HALF_C, abs=0.01)


def test_black_surfaces_read_their_temperature_to_the_bit(two_boxes: Stage) -> None:
    celsius = np.random.default_rng(0).uniform(-30.0, 90.0, 50)
    assert (mixed(celsius, np.ones(50), np.full(50, 500.0)) == celsius).all()
    mirror = Material(GREY, emissivity=1.0, heat_mirror=True)
    behind = wall("behind", -2.0, 80.0, Material(GREY))
    assert (reading(two_boxes, wall("front", 3.0, 21.7, mirror), behind) == 21.7).all()


def test_a_mirror_shows_the_wall_behind_the_camera(two_boxes: Stage) -> None:
    front = wall("front", 3.0, 10.0, Material(GREY, emissivity=0.0, heat_mirror=True))
    behind = wall("behind", -2.0, 80.0, Material(GREY))
    np.testing.assert_allclose(reading(two_boxes, front, behind), 80.0, atol=1e-9)
    np.testing.assert_allclose(reading(two_boxes, front), -5.0, atol=1e-9)  # beyond all surfaces


def test_half_a_mirror_mixes_its_own_and_what_it_shows(two_boxes: Stage) -> None:
    front = wall("front", 3.0, 26.85, Material(GREY, emissivity=0.5, heat_mirror=True))
    behind = wall("behind", -2.0, 126.85, Material(GREY))
    np.testing.assert_allclose(reading(two_boxes, front, behind), HALF_AND_HALF_C, atol=0.01)


def test_what_a_mirror_shows_emits_with_its_own_emissivity(two_boxes: Stage) -> None:
    stage = dataclasses.replace(two_boxes, surroundings_c=constant(26.85))
    front = wall("front", 3.0, 10.0, Material(GREY, emissivity=0.0, heat_mirror=True))
    for mirror in (False, True):  # a second mirror scatters: one bounce
        grey = Material(GREY, emissivity=0.5, heat_mirror=mirror)
        behind = wall("behind", -2.0, 126.85, grey)
        np.testing.assert_allclose(reading(stage, front, behind), HALF_AND_HALF_C, atol=0.01)


def test_a_rough_surface_reflects_the_mean_of_its_surroundings(two_boxes: Stage) -> None:
    stage = dataclasses.replace(  # 126.85 °C for surfaces that face −y
        two_boxes, surroundings_c=lambda normals: 26.85 - 100.0 * normals[:, 1]
    )
    front = wall("front", 3.0, 26.85, Material(GREY, emissivity=0.5))
    behind = wall("behind", -2.0, 500.0, Material(GREY))
    np.testing.assert_allclose(reading(stage, front, behind), HALF_AND_HALF_C, atol=0.01)


def test_a_ball_shows_what_is_beyond_in_the_direction_of_reflection(two_boxes: Stage) -> None:
    """Smooth normals: at the height h of a ball of radius 1 seen from afar, sin a = h is the
    normal's elevation and the reflected ray rises by 2 a."""
    ball = Solid(
        "ball", sphere(1.0, 64), Material(GREY, emissivity=0.0, heat_mirror=True),
        constant(0.0), (0.0, 1000.0, -1.0),
    )  # fmt: skip
    stage = dataclasses.replace(two_boxes, solids=(ball,), beyond_c=lambda d: 20.0 + 10.0 * d[:, 2])
    camera = Camera(pinhole(0.12, 49, 49), ahead().viewmat, 49, 49)
    column = exact_temperature(camera, stage, Triangles.of([ball]), 1)[:, 24]
    metres = 1000.0 * 2.0 * np.tan(np.radians(0.06)) / 49
    height = (24 - np.arange(49)) * metres
    inner = np.abs(height) < 0.8
    expected = 20.0 + 10.0 * np.sin(2.0 * np.arcsin(height[inner]))
    np.testing.assert_allclose(column[inner], expected, atol=0.15)
