from __future__ import annotations

import numpy as np

from mrgs.export.splat import write_splat
from mrgs.export.splats import shaded_splats, to_bytes
from mrgs.scene import RGB
from tests.helpers.exports import make_baked


def test_thirty_two_bytes_per_splat_the_largest_first(tmp_path):
    splats = shaded_splats(make_baked(), RGB)
    data = write_splat(tmp_path / "a.splat", splats).read_bytes()
    assert len(data) == 50 * 32
    size = splats.scales.prod(axis=1) * splats.opacities
    order = np.argsort(-size)
    floats = np.frombuffer(data, "<f4").reshape(50, 8)
    np.testing.assert_array_equal(floats[:, :3], splats.means[order])
    np.testing.assert_array_equal(floats[:, 3:6], splats.scales[order])
    packed = np.frombuffer(data, np.uint8).reshape(50, 32)[:, 24:]
    np.testing.assert_array_equal(packed[:, :3], splats.base_colors[order])
    np.testing.assert_array_equal(packed[:, 3], to_bytes(splats.opacities[order]))
    np.testing.assert_allclose(
        (packed[:, 4:].astype(float) - 128) / 128, splats.quats[order], atol=1 / 128
    )
