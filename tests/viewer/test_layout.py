from __future__ import annotations

import numpy as np
import pytest
import torch

from mrgs.scene import RGB, THERMAL
from mrgs.viewer.painting import DrawnPicture
from mrgs.viewer.panes import panes_of
from tests.helpers.scenes import write_scene
from tests.helpers.subjects import MODES


@pytest.mark.parametrize("name", ["colour", "temperature", "depth", "blend", "split"])
def test_one_pane_fills_the_picture(name, camera):
    mode = MODES[name]
    (pane,) = panes_of(mode, camera, None)
    assert (pane.kind, pane.modalities, pane.left, pane.top) == (mode.kind, mode.modalities, 0, 0)
    assert pane.camera is camera


def test_side_by_side_shows_the_same_middle_twice(camera):
    left, right = panes_of(MODES["side_by_side"], camera, None)
    assert (left.modalities, right.modalities) == ((RGB,), (THERMAL,))
    assert (left.title, right.title) == ("Colour", "Temperature")
    assert (left.left, right.left, left.camera.width) == (0, 80, 80)
    whole, depth = camera.project(torch.tensor([0.0, 0.1, 0.2]))
    half, same_depth = right.camera.project(torch.tensor([0.0, 0.1, 0.2]))
    torch.testing.assert_close(half, whole - torch.tensor([40.0, 0.0]))
    assert same_depth == depth


def test_photos_stand_beside_the_model(camera, balls):
    view = balls.train[0]
    panes = panes_of(MODES["photos"], camera, view)
    kinds = ("photo", "image")
    assert [(pane.modalities, pane.kind) for pane in panes] == [
        ((modality,), kind) for modality in (RGB, THERMAL) for kind in kinds
    ]
    for pane in panes:
        assert pane.left + pane.camera.width <= 160
        assert pane.top + pane.camera.height <= 120
        assert pane.camera.width / pane.camera.height == pytest.approx(4 / 3, rel=0.03)
        torch.testing.assert_close(pane.camera.viewmat, view.cameras[RGB].viewmat)


def test_panes_do_not_overlap(camera, balls):
    for mode in ("side_by_side", "photos"):
        covered = np.zeros((120, 160), int)
        for pane in panes_of(MODES[mode], camera, balls.train[0]):
            covered[
                pane.top : pane.top + pane.camera.height, pane.left : pane.left + pane.camera.width
            ] += 1
        assert covered.max() == 1


def test_each_thermal_pane_has_the_thermal_camera(camera, tmp_path):
    from mrgs.data import load_scene

    view = load_scene(write_scene(tmp_path / "scene", two_cameras=True)).train[0]
    for pane in panes_of(MODES["photos"], camera, view):
        (modality,) = pane.modalities
        torch.testing.assert_close(pane.camera.viewmat, view.cameras[modality].viewmat)
    assert not torch.equal(view.cameras[THERMAL].viewmat, view.cameras[RGB].viewmat)
    (difference,) = panes_of(MODES["difference"], camera, view)
    torch.testing.assert_close(difference.camera.viewmat, view.cameras[THERMAL].viewmat)


def test_places_are_found_in_their_panes(camera):
    panes = panes_of(MODES["side_by_side"], camera, None)
    drawn = DrawnPicture(camera, panes, (), {}, np.zeros((120, 160, 3), np.uint8))
    place = drawn.place(0.75, 0.25)
    assert place.pane is panes[1]
    assert (place.u, place.v) == (0.5, 0.25)
    assert drawn.place(1.01, 0.25) is None
    assert drawn.place(0.1, -0.01) is None


def test_a_view_without_thermal_has_no_difference(camera, tmp_path):
    from mrgs.data import load_scene

    view = load_scene(write_scene(tmp_path / "scene", thermal=False)).train[0]
    assert panes_of(MODES["difference"], camera, view) == ()
    panes = panes_of(MODES["photos"], camera, view)
    assert [(pane.modalities, pane.kind) for pane in panes] == [
        ((RGB,), "photo"),
        ((RGB,), "image"),
    ]
