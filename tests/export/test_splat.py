from __future__ import annotations

import json
import shutil

import numpy as np

from mrgs.export import export
from mrgs.export.splat import write_splat
from mrgs.export.splats import shaded_splats, to_bytes
from mrgs.marks import open_marks
from mrgs.runs.open import load_run
from mrgs.scene import RGB, THERMAL
from tests.helpers.exports import make_baked


def test_the_loss_is_that_of_baking_not_of_a_corrected_emissivity(run, scene, tmp_path):
    shutil.copytree(run.folder.path, tmp_path / "run")
    marks = open_marks(load_run(tmp_path / "run"), scene)
    camera = scene.train_photos(THERMAL)[0].camera
    low, high = ((share * camera.width, share * camera.height) for share in (0.4, 0.6))
    mark = marks.box(camera, low, high, "B1")
    marks.change(mark.name, emissivity=0.5, reflected_c=0.0)
    export(marks.run, scene, "splat", tmp_path / "out")
    rgb, thermal = (
        json.loads((tmp_path / "out" / f"{name}.splat.json").read_text(encoding="utf-8"))
        for name in ("rgb", "thermal")
    )
    assert abs(rgb["baking_loss_db"]["thermal"]) < 1e-3
    assert abs(thermal["baking_loss_db"]["thermal"]) < 1e-3
    assert rgb["baking_loss_db"]["rgb"] > thermal["baking_loss_db"]["rgb"]


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


def test_a_component_of_one_is_the_largest_byte(tmp_path):
    splats = shaded_splats(make_baked(4), RGB)
    splats.quats[:] = np.concatenate([np.eye(4)[:2], -np.eye(4)[:2]])
    data = np.frombuffer(write_splat(tmp_path / "a.splat", splats).read_bytes(), np.uint8)
    found = {tuple(row) for row in data.reshape(4, 32)[:, 28:].tolist()}
    assert found == {
        (255, 128, 128, 128), (128, 255, 128, 128), (0, 128, 128, 128), (128, 0, 128, 128),
    }  # fmt: skip
