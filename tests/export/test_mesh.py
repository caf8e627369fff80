from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mrgs.errors import RunError
from mrgs.export.mesh import build_mesh, write_mesh_ply
from mrgs.scene import RGB
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
    with pytest.raises(RunError, match="no view of the model is opaque enough to show a surface"):
        build_mesh(haze, wide_scene, resolution=24)


def test_depths_that_agree_nowhere_have_no_mesh(globe, wide_scene):
    alone = replace(wide_scene, train=wide_scene.train[:1])
    with pytest.raises(RunError, match="the depths of the model's views agree nowhere"):
        build_mesh(globe, alone, resolution=24)
