from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from mrgs.data import load_scene
from mrgs.scene import Camera
from mrgs_synth.cameras import Frame
from mrgs_synth.dates import SPREAD, Change, Patch, _change, _patched, synthesize_dates


def test_a_camera_sees_the_same_in_other_coordinates():
    turn = Rotation.from_euler("zyx", (50, -20, 70), degrees=True).as_matrix()
    frame = Frame(1.7, turn, np.array([1.0, -2.0, 3.0]))
    camera = Camera.from_fov(64, 48, 60).look_at((0.0, -4.0, 1.0), (0.0, 0.0, 0.5))
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    pixels, depth = camera.project(torch.from_numpy(points))
    moved, farther = frame.camera(camera).project(torch.from_numpy(frame.points(points)))
    torch.testing.assert_close(moved, pixels)
    torch.testing.assert_close(farther, 1.7 * depth)
    assert not frame.world.metric


def test_a_patch_warms_its_solid_about_its_middle(two_boxes):
    place = (1.0, 0.5, 0.0)
    change = Change("new", "slab", place, Patch(0.2, 0.0), Patch(0.2, 3.0))
    solid = _patched(two_boxes, [(change, change.after)]).solids[0]
    points = np.array([place, (1.15, 0.5, 0.0), (1.3, 0.5, 0.0)])
    np.testing.assert_allclose(solid.temperature_at(points), [23.0, 23.0, 20.0])
    assert _patched(two_boxes, [(change, change.before)]).solids == two_boxes.solids


def test_kinds_of_changes_are_what_their_names_say():
    rng = np.random.default_rng(0)
    made = {
        kind: _change(kind, "wall", np.zeros(3), 0.1, rng)
        for kind in ("new", "gone", "grown", "shrunk", "warmer", "colder", "same")
    }
    assert made["new"].before.kelvin == made["gone"].after.kelvin == 0.0
    assert made["grown"].after.radius_m == pytest.approx(SPREAD * made["grown"].before.radius_m)
    assert made["shrunk"].after.radius_m < made["shrunk"].before.radius_m
    assert made["warmer"].after.kelvin > made["warmer"].before.kelvin
    assert made["colder"].after.kelvin < made["colder"].before.kelvin
    assert made["same"].before == made["same"].after


def test_two_dates_from_end_to_end(tmp_path):
    pytest.importorskip("mitsuba", reason="the extra synth is not installed")
    small = {"width": 96, "height": 72, "train_views": 6, "samples": 2}
    found = synthesize_dates(
        tmp_path / "a", tmp_path / "b", scene="facade", seed=3, changes=1, **small
    )
    first, second = load_scene(tmp_path / "a"), load_scene(tmp_path / "b")
    assert first.world.metric
    assert not second.world.metric
    facts = json.loads((tmp_path / "a/truth/changes.json").read_text())
    assert [each["kind"] for each in facts["changes"]] == [each.kind for each in found] == ["new"]
    steps = []
    for view in first.train:
        before, after = (
            np.asarray(Image.open(tmp_path / f"a/truth/{kind}/{view.name}.tiff"))
            for kind in ("temperature", "after")
        )
        steps.append(after - before)
    beside = np.stack(steps) - np.median(steps)
    kelvin = found[0].after.kelvin
    assert np.max(beside * np.sign(kelvin)) == pytest.approx(abs(kelvin), abs=0.7)
