from __future__ import annotations

import sys
from dataclasses import replace

import laspy
import numpy as np
import pytest
import torch

from mrgs.errors import ConfigError, RunError
from mrgs.export.points import write_las, write_points_ply
from mrgs.export.surface_points import MIN_OPACITY, surface_points
from mrgs.scene import RGB, THERMAL
from tests.helpers.exports import read_ply


@pytest.fixture
def points(globe, wide_scene):
    return surface_points(globe, wide_scene)


def test_points_have_what_the_cameras_see_there(points):
    warm, cold = points.positions[:, 2] > 0.1, points.positions[:, 2] < -0.1
    assert min(warm.sum(), cold.sum()) > 500
    temperatures = points.columns["temperature_c"]
    np.testing.assert_allclose(np.median(temperatures[warm]), 25, atol=0.3)
    np.testing.assert_allclose(np.median(temperatures[cold]), 15, atol=0.3)
    assert (points.columns["red"][warm] > points.columns["blue"][warm]).mean() > 0.98


def test_the_sky_is_no_points(globe_under_sky, wide_scene, points):
    found = surface_points(globe_under_sky, wide_scene)
    assert len(found.positions) > 0.95 * len(points.positions)
    assert np.linalg.norm(found.positions, axis=1).max() < 0.51


def test_faint_and_hidden_splats_are_no_points(globe, wide_scene, points):
    faint = globe.means[:, 0] > 0
    opacity = torch.where(faint, 0.9 * MIN_OPACITY, globe.opacities[RGB])
    hidden = globe.means * 0.3  # inside the opaque sphere
    model = replace(
        globe.map_tensors(lambda tensor: torch.cat([tensor] * 2)),
        means=torch.cat([globe.means, hidden]),
        opacities=dict.fromkeys((RGB, THERMAL), torch.cat([opacity, globe.opacities[RGB]])),
    )
    found = surface_points(model, wide_scene).positions
    assert len(found) < 0.6 * len(points.positions)
    on_shell = np.linalg.norm(found, axis=1) > 0.4
    assert (found[on_shell, 0] <= 0).all()
    seen_through = (~on_shell).sum()  # behind the half that is faint
    assert seen_through < 0.5 * len(hidden)


def test_each_point_has_the_opacity_of_its_splat(globe, wide_scene):
    """The largest of its modalities'; on one side the splats are fainter, hidden ones are not."""
    thermal = torch.where(globe.means[:, 0] < 0, 0.6, 0.9)
    hidden = torch.full_like(thermal, 0.95)
    rgb = torch.full((2 * len(thermal),), 0.5)
    model = replace(
        globe.map_tensors(lambda tensor: torch.cat([tensor] * 2)),
        means=torch.cat([0.3 * globe.means, globe.means]),
        opacities={RGB: rgb, THERMAL: torch.cat([hidden, thermal])},
    )
    found = surface_points(model, wide_scene)
    on_shell = np.linalg.norm(found.positions, axis=1) > 0.4
    expected = np.where(found.positions[:, 0] < 0, np.float32(0.6), np.float32(0.9))
    np.testing.assert_array_equal(found.opacities[on_shell], expected[on_shell])
    assert on_shell.mean() > 0.9


def test_a_model_of_haze_has_no_points(globe, wide_scene):
    haze = torch.full_like(globe.opacities[RGB], 0.01)
    with pytest.raises(RunError, match=r"0\.3 or more"):
        surface_points(replace(globe, opacities=dict.fromkeys((RGB, THERMAL), haze)), wide_scene)


def test_splats_that_no_camera_sees_are_no_points(globe, wide_scene):
    away = torch.cat([globe.means[:-1], torch.full((1, 3), 100.0)])
    thermal = torch.full_like(globe.opacities[THERMAL], 0.01)
    rgb = torch.full_like(globe.opacities[RGB], 0.29)
    thermal[-1] = 0.9
    with pytest.raises(RunError, match="camera sees"):
        surface_points(
            replace(globe, means=away, opacities={RGB: rgb, THERMAL: thermal}), wide_scene
        )


def test_the_ply_holds_position_colour_temperature_and_opacity(tmp_path, points):
    rows = read_ply(write_points_ply(tmp_path / "points.ply", points))[1]["vertex"]
    assert rows.dtype.names == ("x", "y", "z", "red", "green", "blue", "temperature_c", "opacity")
    np.testing.assert_array_equal(rows["temperature_c"], points.columns["temperature_c"])
    np.testing.assert_array_equal(rows["green"], points.columns["green"])


def test_without_celsius_the_column_says_so(tmp_path, globe, wide_scene):
    points = surface_points(replace(globe, temperature=None), wide_scene)
    rows = read_ply(write_points_ply(tmp_path / "points.ply", points))[1]["vertex"]
    assert rows.dtype.names[6] == "temperature_normalised"
    assert rows["temperature_normalised"].max() < 1


@pytest.mark.parametrize("spread", [1.0, 1e5])
def test_the_las_file_reads_back(tmp_path, points, spread):
    points = replace(points, positions=points.positions * np.float32(spread))
    las = laspy.read(write_las(tmp_path / "points.las", points))
    assert las.header.version.minor == 4
    np.testing.assert_allclose(las.xyz, points.positions, atol=1e-6 * max(1, spread / 100))
    np.testing.assert_array_equal(las["temperature_c"], points.columns["temperature_c"])
    np.testing.assert_array_equal(las["opacity"], points.opacities)
    for name in ("red", "green", "blue"):
        np.testing.assert_array_equal(las[name], points.columns[name].astype(int) * 257)


def test_without_laspy_the_extra_is_named(tmp_path, points, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(ConfigError, match=r"laspy.*mrgs\[export\]"):
        write_las(tmp_path / "points.las", points)
