from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mrgs.data.ply import read_ply as read_points
from mrgs.data.ply import write_ply
from mrgs.errors import RunError
from mrgs.export.ply import logit, write_combined_ply, write_splat_ply
from mrgs.export.splats import shaded_splats, thermal_scale, thermal_splats
from mrgs.scene import RGB, THERMAL
from tests.helpers.exports import make_baked, read_ply, splats_from


def test_the_properties_stand_in_3dgs_s_order(tmp_path):
    path = write_splat_ply(tmp_path / "rgb.ply", shaded_splats(make_baked(), RGB))
    names = read_ply(path)[1]["vertex"].dtype.names
    head, tail = ["x", "y", "z", "nx", "ny", "nz"], ["opacity", "scale_0", "scale_1", "scale_2"]
    coefficients = [f"f_dc_{i}" for i in range(3)] + [f"f_rest_{i}" for i in range(45)]
    assert list(names) == [*head, *coefficients, *tail, "rot_0", "rot_1", "rot_2", "rot_3"]


def test_higher_coefficients_are_stored_channel_by_channel(tmp_path):
    baked = make_baked()
    rows = read_ply(write_splat_ply(tmp_path / "rgb.ply", shaded_splats(baked, RGB)))[1]["vertex"]
    np.testing.assert_array_equal(rows["f_rest_0"], baked.sh(RGB)[:, 1, 0])
    np.testing.assert_array_equal(rows["f_rest_14"], baked.sh(RGB)[:, 15, 0])
    np.testing.assert_array_equal(rows["f_rest_15"], baked.sh(RGB)[:, 1, 1])
    np.testing.assert_array_equal(rows["f_rest_44"], baked.sh(RGB)[:, 15, 2])


def test_scales_are_logarithms_and_opacities_logits(tmp_path):
    baked = make_baked()
    rows = read_ply(write_splat_ply(tmp_path / "rgb.ply", shaded_splats(baked, RGB)))[1]["vertex"]
    np.testing.assert_allclose(rows["scale_2"], baked.scales[:, 2].log(), rtol=1e-6)
    np.testing.assert_allclose(rows["opacity"], torch.logit(baked.opacities[RGB]), atol=1e-5)
    np.testing.assert_array_equal(
        rows["rot_0"], torch.nn.functional.normalize(baked.quats, dim=1)[:, 0]
    )


def test_what_is_read_back_is_what_was_written(tmp_path):
    splats = shaded_splats(make_baked(), RGB)
    back = splats_from(read_ply(write_splat_ply(tmp_path / "rgb.ply", splats))[1]["vertex"])
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(back, name), getattr(splats, name), rtol=2e-6, atol=1e-6)


def test_the_thermal_file_has_degree_zero_alone(tmp_path):
    baked = make_baked()
    path = write_splat_ply(tmp_path / "thermal.ply", thermal_splats(baked, thermal_scale(baked)))
    assert not any(name.startswith("f_rest") for name in read_ply(path)[1]["vertex"].dtype.names)


def test_one_file_holds_both_opacities_and_the_temperature(tmp_path):
    baked = make_baked()
    rows = read_ply(write_combined_ply(tmp_path / "both.ply", shaded_splats(baked, RGB), baked))[1][
        "vertex"
    ]
    np.testing.assert_allclose(
        rows["temperature_c"], baked.temperature.to_celsius(baked.temperatures), rtol=1e-6
    )
    np.testing.assert_allclose(
        rows["opacity_thermal"], torch.logit(baked.opacities[THERMAL]), atol=1e-5
    )
    np.testing.assert_allclose(rows["opacity"], torch.logit(baked.opacities[RGB]), atol=1e-5)


def test_without_celsius_the_normalised_value_stands_there(tmp_path):
    baked = make_baked(temperature=None)
    rows = read_ply(write_combined_ply(tmp_path / "both.ply", shaded_splats(baked, RGB), baked))[1][
        "vertex"
    ]
    assert "temperature_c" not in rows.dtype.names
    np.testing.assert_array_equal(rows["temperature_normalised"], baked.temperatures)


def test_extreme_opacities_and_scales_stay_finite(tmp_path):
    assert np.isfinite(logit(np.array([0.0, 1.0], np.float32))).all()
    splats = replace(shaded_splats(make_baked(), RGB), scales=np.zeros((50, 3), np.float32))
    rows = read_ply(write_splat_ply(tmp_path / "rgb.ply", splats))[1]["vertex"]
    assert np.isfinite(rows["scale_0"]).all()


def test_comments_are_single_ascii_lines(tmp_path):
    comments = ["30 °C", "two\nlines", "σ"]
    path = write_splat_ply(tmp_path / "rgb.ply", shaded_splats(make_baked(), RGB), comments)
    celsius, *others = read_ply(path)[0]
    assert celsius == "30 degrees Celsius"
    assert others == ["two lines", "?"]


def test_the_program_s_own_reader_opens_it(tmp_path):
    baked = make_baked()
    positions, _ = read_points(write_splat_ply(tmp_path / "rgb.ply", shaded_splats(baked, RGB)))
    np.testing.assert_array_equal(positions.astype(np.float32), baked.means)


@pytest.mark.parametrize("dtype", [np.int32, np.int64])
def test_faces_are_lists(tmp_path, dtype):
    columns = {"x": np.zeros(3, np.float32)}
    faces = np.array([[0, 1, 2], [2, 1, 0]], dtype)
    path = write_ply(tmp_path / "m.ply", {"vertex": columns, "face": faces})
    np.testing.assert_array_equal(read_ply(path)[1]["face"], faces)


def test_a_folder_in_the_way_is_named(tmp_path):
    (tmp_path / "rgb.ply").mkdir()
    with pytest.raises(RunError, match=r"rgb\.ply"):
        write_splat_ply(tmp_path / "rgb.ply", shaded_splats(make_baked(), RGB))
    assert list(tmp_path.iterdir()) == [tmp_path / "rgb.ply"]
