from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from mrgs.scene import Camera
from mrgs_synth.cameras import look_at, pinhole
from mrgs_synth.hits import Triangles, first_hits
from mrgs_synth.planck import band_radiance, temperature
from mrgs_synth.radiometry import exact_temperature
from mrgs_synth.shapes import sphere
from mrgs_synth.stage import Solid, Stage


def camera_at(
    position: list[float], target: list[float], width: int = 64, height: int = 48
) -> Camera:
    viewmat = torch.from_numpy(look_at(np.array(position), np.array(target)))
    return Camera(pinhole(55.0, width, height), viewmat, width, height)


def test_floor_depth_is_exact_though_it_reaches_behind_the_camera(two_boxes: Stage) -> None:
    camera = camera_at([0.0, -1.0, 0.5], [0.0, 0.0, 0.0])
    hits = first_hits(camera, Triangles.of(two_boxes.solids[:1]))
    assert (hits.solid == 0).all()
    np.testing.assert_allclose(hits.points[..., 2], 0.0, atol=1e-9)
    homogeneous = np.concatenate([hits.points, np.ones((48, 64, 1))], axis=-1)
    in_camera = homogeneous @ camera.viewmat.numpy()[:3].T
    np.testing.assert_allclose(in_camera[..., 2], hits.depth_m, rtol=1e-9)
    pixel = in_camera @ camera.K.numpy().T
    u, v = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    np.testing.assert_allclose(pixel[..., 0] / pixel[..., 2], u, atol=1e-6)
    np.testing.assert_allclose(pixel[..., 1] / pixel[..., 2], v, atol=1e-6)


def test_nearest_surface_wins(two_boxes: Stage) -> None:
    camera = camera_at([0.1, 0.0, 1.2], [0.1, 0.01, 0.0])
    hits = first_hits(camera, Triangles.of(two_boxes.solids))
    assert hits.solid[24, 32] == 1
    assert hits.points[24, 32, 2] == pytest.approx(0.2)
    reordered = first_hits(camera, Triangles.of(two_boxes.solids[::-1]))
    np.testing.assert_array_equal(reordered.depth_m, hits.depth_m)


def test_sphere_depth(two_boxes: Stage) -> None:
    ball = dataclasses.replace(
        two_boxes.solids[0], mesh=sphere(0.5, segments=256), position=(0.0, 0.0, -0.5)
    )
    camera = camera_at([2.0, 0.0, 0.0], [0.0, 0.0, 0.0], 65, 49)
    hits = first_hits(camera, Triangles.of([ball]))
    hit = hits.solid == 0
    np.testing.assert_allclose(np.linalg.norm(hits.points[hit], axis=-1), 0.5, atol=3e-4)
    assert hits.depth_m[24, 32] == pytest.approx(1.5, abs=3e-4)


def test_rays_that_meet_nothing(two_boxes: Stage) -> None:
    up = camera_at([0.0, -1.0, 0.5], [0.0, 0.0, 5.0])
    hits = first_hits(up, Triangles.of(two_boxes.solids))
    assert (hits.solid == -1).all()
    assert (hits.depth_m == 0.0).all()
    celsius = exact_temperature(up, two_boxes, Triangles.of(two_boxes.solids), 2)
    np.testing.assert_array_equal(celsius, -5.0)


def test_temperature_beyond_the_surfaces_depends_on_the_direction(two_boxes: Stage) -> None:
    sky = dataclasses.replace(two_boxes, beyond_c=lambda directions: directions[:, 2])
    triangles = Triangles.of(two_boxes.solids)
    camera = camera_at([0.0, -1.0, 1.0], [0.0, 1.0, 1.0], 65, 49)
    celsius = exact_temperature(camera, sky, triangles, 1)
    assert celsius[24, 32] == pytest.approx(0.0, abs=1e-9)  # straight ahead, along the horizon
    focal = camera.K[0, 0].item()
    assert celsius[0, 32] == pytest.approx(np.sin(np.arctan(24 / focal)))
    assert celsius[48, 32] == 20.0  # the floor


def test_temperature_is_that_of_the_mean_radiance_within_the_pixel(two_boxes: Stage) -> None:
    triangles = Triangles.of(two_boxes.solids)
    camera = camera_at([0.0, -0.7, 0.9], [0.1, 0.0, 0.1])
    coarse = exact_temperature(camera, two_boxes, triangles, 4)
    fine = exact_temperature(camera.resized(256, 192), two_boxes, triangles, 1)
    received = band_radiance(fine).reshape(48, 4, 64, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(coarse, temperature(received))
    assert coarse.min() == pytest.approx(20.0)
    assert 51.5 < coarse.max() <= 52.0  # 50 + 10 z at the lid, z = 0.2
    assert ((coarse > 25.0) & (coarse < 45.0)).any()  # the outline mixes both


def test_temperature_field_is_read_in_the_solids_own_frame(two_boxes: Stage) -> None:
    solid: Solid = dataclasses.replace(two_boxes.solids[1], temperature_c=lambda p: p[:, 0])
    world = solid.world_mesh().vertices
    np.testing.assert_allclose(solid.temperature_at(world), solid.mesh.vertices[:, 0], atol=1e-12)
