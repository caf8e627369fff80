from __future__ import annotations

import sys
from dataclasses import replace

import laspy
import numpy as np
import pytest
import torch

from mrgs.errors import ConfigError, RunError
from mrgs.export.las import write_las
from mrgs.export.points import MIN_OPACITY, temperature_points, write_points_ply


@pytest.fixture
def points(globe, wide_scene):
    return temperature_points(globe, wide_scene)


def test_points_have_what_the_cameras_see_there(points):
    warm, cold = points.positions[:, 2] > 0.1, points.positions[:, 2] < -0.1
    assert min(warm.sum(), cold.sum()) > 500
    np.testing.assert_allclose(np.median(points.temperatures[warm]), 25, atol=0.3)
    np.testing.assert_allclose(np.median(points.temperatures[cold]), 15, atol=0.3)
    assert (points.colors[warm, 0] > points.colors[warm, 2]).mean() > 0.98


def test_the_sky_is_no_points(globe_under_sky, wide_scene, points):
    found = temperature_points(globe_under_sky, wide_scene)
    assert len(found.positions) > 0.95 * len(points.positions)
    assert np.linalg.norm(found.positions, axis=1).max() < 0.51


def test_faint_and_hidden_splats_are_no_points(globe, wide_scene, points):
    faint = globe.means[:, 0] > 0
    opacity = torch.where(faint, 0.9 * MIN_OPACITY, globe.opacity_rgb)
    hidden = globe.means * 0.3  # inside the opaque sphere
    model = replace(
        globe,
        means=torch.cat([globe.means, hidden]),
        opacity_rgb=torch.cat([opacity, globe.opacity_rgb]),
        opacity_thermal=torch.cat([opacity, globe.opacity_rgb]),
        **{
            name: torch.cat([getattr(globe, name)] * 2)
            for name in ("quats", "scales", "sh", "temperatures")
        },
    )
    found = temperature_points(model, wide_scene).positions
    assert len(found) < 0.6 * len(points.positions)
    on_shell = np.linalg.norm(found, axis=1) > 0.4
    assert (found[on_shell, 0] <= 0).all()
    seen_through = (~on_shell).sum()  # behind the half that is faint
    assert seen_through < 0.5 * len(hidden)


def test_a_model_of_haze_has_no_points(globe, wide_scene):
    haze = torch.full_like(globe.opacity_rgb, 0.01)
    with pytest.raises(
        RunError, match=r"no splat has an opacity of 0\.3 or more, so there are no points"
    ):
        temperature_points(replace(globe, opacity_rgb=haze, opacity_thermal=haze), wide_scene)


def test_splats_that_no_camera_sees_are_no_points(globe, wide_scene):
    away = torch.cat([globe.means[:-1], torch.full((1, 3), 100.0)])
    thermal = torch.full_like(globe.opacity_thermal, 0.01)
    rgb = torch.full_like(globe.opacity_rgb, 0.29)
    thermal[-1] = 0.9
    with pytest.raises(RunError, match="no opaque splat lies on a surface that a camera sees"):
        temperature_points(
            replace(globe, means=away, opacity_rgb=rgb, opacity_thermal=thermal), wide_scene
        )


def test_the_ply_holds_position_colour_temperature_and_opacity(tmp_path, points, read_ply):
    rows = read_ply(write_points_ply(tmp_path / "points.ply", points))[1]["vertex"]
    assert rows.dtype.names == ("x", "y", "z", "red", "green", "blue", "temperature_c", "opacity")
    np.testing.assert_array_equal(rows["temperature_c"], points.temperatures)
    np.testing.assert_array_equal(rows["green"], points.colors[:, 1])


def test_without_celsius_the_column_says_so(tmp_path, globe, wide_scene, read_ply):
    points = temperature_points(replace(globe, temperature=None), wide_scene)
    rows = read_ply(write_points_ply(tmp_path / "points.ply", points))[1]["vertex"]
    assert rows.dtype.names[6] == "temperature_normalised"
    assert rows["temperature_normalised"].max() < 1


@pytest.mark.parametrize("spread", [1.0, 1e5])
def test_the_las_file_reads_back(tmp_path, points, spread):
    points = replace(points, positions=points.positions * np.float32(spread))
    las = laspy.read(write_las(tmp_path / "points.las", points))
    assert las.header.version.minor == 4
    np.testing.assert_allclose(las.xyz, points.positions, atol=1e-6 * max(1, spread / 100))
    np.testing.assert_array_equal(las["temperature_c"], points.temperatures)
    np.testing.assert_array_equal(las["opacity"], points.opacities)
    np.testing.assert_array_equal(
        np.stack([las.red, las.green, las.blue], axis=1), points.colors.astype(int) * 257
    )


def test_without_laspy_the_extra_is_named(tmp_path, points, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(
        ConfigError, match=r'LAS files need the package laspy: pip install "mrgs\[export\]"'
    ):
        write_las(tmp_path / "points.las", points)
