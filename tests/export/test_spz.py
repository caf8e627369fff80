from __future__ import annotations

import gzip
import struct
from dataclasses import replace

import numpy as np
import pytest

from mrgs.errors import RunError
from mrgs.export.splats import shaded_splats, thermal_scale, thermal_splats
from mrgs.export.spz import write_spz
from mrgs.scene import RGB
from tests.helpers.exports import make_baked


def unpack(path):
    """Version, splats, degree, fractional bits, and what follows."""
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<IIIBBBB", data)
    assert (magic, flags, reserved) == (0x5053474E, 0, 0)
    return version, count, degree, bits, np.frombuffer(data, np.uint8, offset=16)


def quats_of(words):
    """The rotations of ``words``, one number at a time, from the format's description: wxyz."""
    found = []
    for word in words.tolist():
        largest, rest, xyzw = word >> 30, [], [0.0] * 4
        for place in (20, 10, 0):
            ten = (word >> place) & 1023
            rest.append((-1 if ten >> 9 else 1) * (ten & 511) / 511 / 2**0.5)
        for index, value in zip([i for i in range(4) if i != largest], rest, strict=True):
            xyzw[index] = value
        xyzw[largest] = max(0.0, 1 - sum(value**2 for value in rest)) ** 0.5
        found.append([xyzw[3], *xyzw[:3]])
    return np.array(found)


def test_each_splat_takes_twenty_bytes_and_its_coefficients(tmp_path):
    version, count, degree, _, body = unpack(
        write_spz(tmp_path / "rgb.spz", shaded_splats(make_baked(), RGB))
    )
    assert (version, count, degree, len(body)) == (3, 50, 3, 50 * (20 + 45))
    baked = make_baked()
    thermal = write_spz(tmp_path / "thermal.spz", thermal_splats(baked, thermal_scale(baked)))
    assert unpack(thermal)[2] == 0
    assert len(unpack(thermal)[4]) == 50 * 20


@pytest.mark.parametrize(("size", "bits"), [(1.0, 20), (100.0, 16), (4e6, 1)])
def test_positions_get_as_many_bits_as_the_farthest_leaves(tmp_path, size, bits):
    splats = shaded_splats(make_baked(), RGB)
    splats = replace(splats, means=splats.means / np.abs(splats.means).max() * np.float32(size))
    *_, found, body = unpack(write_spz(tmp_path / "rgb.spz", splats))
    assert found == bits
    parts = body[: 50 * 9].reshape(50, 3, 3).astype(np.int64)
    fixed = parts[..., 0] | parts[..., 1] << 8 | parts[..., 2] << 16
    back = np.where(fixed >= 2**23, fixed - 2**24, fixed) / 2.0**bits * [1, -1, -1]
    np.testing.assert_allclose(back, splats.means, atol=0.51 * 2.0**-bits + 1e-7 * size)


@pytest.mark.parametrize("size", [8.5e6, 1.2e7, 1e9])
def test_splats_beyond_24_bits_are_refused(tmp_path, size):
    splats = shaded_splats(make_baked(), RGB)
    means = splats.means / np.abs(splats.means).max() * np.float32(size)
    with pytest.raises(RunError, match="PLY"):
        write_spz(tmp_path / "rgb.spz", replace(splats, means=means))
    assert list(tmp_path.iterdir()) == []


def test_rotations_are_kept_to_a_third_of_a_degree(tmp_path):
    splats = shaded_splats(make_baked(2000), RGB)
    splats.quats[:4] = np.eye(4)  # ties and signs
    splats.quats[4:6] = [[-0.5, 0.5, -0.5, 0.5], [0.5, 0.5, 0.5, 0.5]]
    body = unpack(write_spz(tmp_path / "rgb.spz", splats))[-1]
    words = body[2000 * 16 : 2000 * 20].view("<u4")
    turned = splats.quats * [1, 1, -1, -1]
    cosine = np.abs((quats_of(words) * turned).sum(axis=1)).clip(0, 1)
    assert np.rad2deg(2 * np.arccos(cosine)).max() < 0.33


def test_the_same_model_gives_the_same_bytes(tmp_path):
    first, second = (
        write_spz(tmp_path / name, shaded_splats(make_baked(), RGB)).read_bytes()
        for name in ("a.spz", "b.spz")
    )
    assert first == second
