from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mrgs.errors import RunError
from mrgs.export.mesh import _without_specks, build_mesh, fuse, write_mesh_ply
from mrgs.scene import RGB, Camera
from mrgs.scene.depth_map import DepthMap
from tests.helpers.exports import read_ply

RADIUS = 0.5


def test_a_sphere_comes_out_with_its_colours_and_temperatures(globe, wide_scene):
    mesh = build_mesh(globe, wide_scene, resolution=48)
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(np.median(radii) - RADIUS) < 0.02
    assert np.percentile(np.abs(radii - RADIUS), 95) < 0.03
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    assert ((a * np.cross(b - a, c - a)).sum(axis=1) > 0).mean() > 0.95  # seen from outside
    warm, cold = mesh.vertices[:, 2] > 0.1, mesh.vertices[:, 2] < -0.1
    assert min(warm.sum(), cold.sum()) > 200
    temperatures = mesh.columns["temperature_c"]
    np.testing.assert_allclose(np.median(temperatures[warm]), 25, atol=0.3)
    np.testing.assert_allclose(np.median(temperatures[cold]), 15, atol=0.3)
    assert (mesh.columns["red"][warm] > mesh.columns["blue"][warm]).mean() > 0.98


def test_the_sky_is_no_surface_and_costs_no_resolution(globe_under_sky, globe, wide_scene):
    mesh, alone = (
        build_mesh(model, wide_scene, resolution=48) for model in (globe_under_sky, globe)
    )
    assert np.linalg.norm(mesh.vertices, axis=1).max() < 1.2 * RADIUS
    assert len(mesh.vertices) > 0.75 * len(
        alone.vertices
    )  # all but the outlines, whose depth is mixed with the sky's


def test_the_file_holds_a_temperature_per_vertex(tmp_path, globe, wide_scene):
    mesh = build_mesh(globe, wide_scene, resolution=24)
    _, elements = read_ply(write_mesh_ply(tmp_path / "mesh.ply", mesh))
    names = ("x", "y", "z", "red", "green", "blue", "temperature_c")
    assert elements["vertex"].dtype.names == names
    np.testing.assert_array_equal(elements["face"], mesh.faces)
    np.testing.assert_array_equal(
        elements["vertex"]["temperature_c"], mesh.columns["temperature_c"]
    )
    assert elements["face"].max() == len(mesh.vertices) - 1  # no vertex is unused


def test_haze_has_no_mesh(globe, wide_scene):
    haze = globe.map_tensors(torch.clone)
    haze.opacities[RGB].fill_(1e-3)
    with pytest.raises(RunError, match="opaque"):
        build_mesh(haze, wide_scene, resolution=24)


def test_depths_that_agree_nowhere_have_no_mesh(globe, wide_scene):
    alone = replace(wide_scene, train=wide_scene.train[:1])
    with pytest.raises(RunError, match="agree nowhere"):
        build_mesh(globe, alone, resolution=24)


def facing(x: float, depth: np.ndarray) -> DepthMap:
    """What a camera 10 before the plane y = 0 sees."""
    camera = Camera.from_fov(60, 60, 40).look_at((x, -10.0, 0.0), (x, 0.0, 0.0))
    return DepthMap(camera, depth.astype(np.float32), np.empty((60, 60, 0), np.float32))


def test_what_lies_far_behind_counts_no_more_than_the_width_of_the_band():
    """A third camera looks past the plane that two see."""
    plane, beyond = np.full((60, 60), 10.0), np.full((60, 60), 13.0)
    field, grid = fuse([facing(0.0, plane), facing(0.3, plane), facing(0.6, beyond)], 40)
    assert np.nanmax(field) <= 1
    samples = np.argwhere(np.isfinite(field))
    y = (grid.origin + grid.step * samples)[:, 1]
    before = field[tuple(samples.T)][y < -0.3]
    assert len(before) > 1000
    assert (before > 0).all()


def test_a_few_points_far_off_cost_no_resolution():
    plane = np.full((60, 60), 10.0)
    strays = plane.copy()
    strays[0, :30] = 10_000.0
    (_, near), (_, far) = (
        fuse([facing(0.0, depth), facing(0.3, plane)], 40) for depth in (plane, strays)
    )
    assert far.step == pytest.approx(near.step, rel=0.2)


def test_samples_are_no_finer_than_pixels():
    maps = [facing(x, np.full((60, 60), 10.0)) for x in (0.0, 0.3)]
    pixel = 10.0 / maps[0].camera.K[0, 0].item()
    assert fuse(maps, 200)[1].step == pytest.approx(pixel)
    assert fuse(maps, 20)[1].step > 2 * pixel


def test_specks_are_left_out_and_faces_keep_their_corners():
    """Of two parts with a hundredth and a thousandth of the faces of a sheet the smaller goes."""
    side = 25
    rows, columns = (axis.ravel() for axis in np.indices((side - 1, side - 1)))
    corner = rows * side + columns
    sheet = np.concatenate([
        np.stack([corner, corner + 1, corner + side], axis=1),
        np.stack([corner + 1, corner + side + 1, corner + side], axis=1),
    ])  # fmt: skip
    first = side * side
    speck = np.array([[first, first + 1, first + 2]])
    fan = first + 3 + np.array([[0, number, number + 1] for number in range(1, 13)])
    faces = np.concatenate([speck, sheet, fan]).astype(np.int32)
    vertices = np.random.default_rng(0).random((first + 3 + 14, 3)).astype(np.float32)
    values = vertices[:, :2].copy()
    found, kept, carried = _without_specks(vertices, faces, values)
    np.testing.assert_array_equal(found[kept], vertices[faces[1:]])
    np.testing.assert_array_equal(carried, found[:, :2])
    assert len(found) == first + 14
