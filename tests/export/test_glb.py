from __future__ import annotations

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mrgs.export.glb import EXTENSION, rotation_to_y, write_glb
from mrgs.export.splats import shaded_splats, shown_temperatures, thermal_scale, thermal_splats
from mrgs.field.spherical_harmonics import C0
from mrgs.scene import RGB
from tests.helpers.exports import make_baked, read_glb, splats_of


def test_an_independent_reader_finds_every_number(tmp_path):
    baked = make_baked()
    splats = shaded_splats(baked, RGB)
    path = write_glb(
        tmp_path / "rgb.glb", splats, properties={"temperature_c": shown_temperatures(baked)}
    )
    found = read_glb(path)
    back = splats_of(found["attributes"])
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(back, name), getattr(splats, name), rtol=1e-6)
    np.testing.assert_allclose(
        np.ravel(found["attributes"]["_TEMPERATURE_C"]), shown_temperatures(baked), rtol=1e-6
    )
    assert found["mode"] == 0


def test_khronos_s_validator_knows_everything_but_the_extension(tmp_path):
    baked = make_baked()
    for splats in (shaded_splats(baked, RGB), thermal_splats(baked, thermal_scale(baked))):
        issues = read_glb(
            write_glb(tmp_path / "a.glb", splats, np.array([0.0, 0.0, 1.0]), {"unit": "°C"})
        )["issues"]
        assert {issue["code"] for issue in issues} == {
            "UNSUPPORTED_EXTENSION",
            "MESH_PRIMITIVE_INVALID_ATTRIBUTE",
        }
        assert all(EXTENSION in issue["pointer"] + issue["message"] for issue in issues)


def document(path):
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<IIIII", data)
    assert (magic, version, length, kind) == (0x46546C67, 2, len(data), 0x4E4F534A)
    return json.loads(data[20 : 20 + size])


def test_the_extension_is_declared_as_its_specification_wants(tmp_path):
    content = document(
        write_glb(tmp_path / "a.glb", shaded_splats(make_baked(7), RGB), extras={"scene": "kettle"})
    )
    primitive = content["meshes"][0]["primitives"][0]
    assert content["extensionsUsed"] == [EXTENSION]
    assert content["asset"]["extras"] == {"scene": "kettle"}
    assert primitive["mode"] == 0
    assert primitive["extensions"][EXTENSION] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    degrees = [name for name in primitive["attributes"] if "SH_DEGREE" in name]
    assert degrees[:2] == [f"{EXTENSION}:SH_DEGREE_0_COEF_0", f"{EXTENSION}:SH_DEGREE_1_COEF_0"]
    assert len(degrees) == 16


@pytest.mark.parametrize("name", ["k", "ke", "ket", "kett"])
def test_both_chunks_begin_and_end_at_multiples_of_four_bytes(tmp_path, name):
    data = write_glb(
        tmp_path / "a.glb", shaded_splats(make_baked(7), RGB), extras={"scene": name}
    ).read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    assert size % 4 == 0
    binary, kind = struct.unpack_from("<II", data, 20 + size)
    assert (binary % 4, kind) == (0, 0x004E4942)
    assert 28 + size + binary == len(data)


def test_readers_without_the_extension_get_linear_colours(tmp_path):
    """0.5 in sRGB is 0.214 in linear light, and 0.03 is 0.0023."""
    splats = shaded_splats(make_baked(2), RGB)
    sh = np.zeros_like(splats.sh)
    sh[:, 0] = (np.array([[0.5] * 3, [0.03] * 3]) - 0.5) / C0
    path = write_glb(tmp_path / "a.glb", replace(splats, sh=sh))
    content = document(path)
    attributes = content["meshes"][0]["primitives"][0]["attributes"]
    view = content["bufferViews"][attributes["COLOR_0"]]
    colors = np.frombuffer(path.read_bytes()[-content["buffers"][0]["byteLength"] :], np.uint8)
    colors = colors[view["byteOffset"] :][: view["byteLength"]].reshape(2, 4)
    np.testing.assert_allclose(colors[:, :3] / 255, [[0.2140] * 3, [0.0023] * 3], atol=0.003)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (0.6, -0.64, 0.48)])
def test_up_becomes_the_y_axis(up):
    turned = Rotation.from_quat(rotation_to_y(np.array(up, dtype=np.float64))).apply(up)
    np.testing.assert_allclose(turned, [0, 1, 0], atol=1e-12)
