from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mrgs.errors import SceneError
from mrgs.prepare.rig.calibrate import calibrate_rig
from mrgs.prepare.rig.contract import FEWEST_MATCHES, RigOptions
from mrgs.prepare.stages import summarise_thermal_camera
from mrgs.scene import RGB, Pixels, PointCloud
from mrgs.scene.lens import Lens
from tests.helpers.rig_room import build_room

KNOWN_FIELD = RigOptions(field_of_view_deg=56.0)


def test_the_thermal_camera_is_found_from_edges_alone(room):
    stages = []
    found = calibrate_rig(
        room.pairs, room.points, KNOWN_FIELD, lambda stage, done, total: stages.append(stage)
    )
    errors_px = room.errors_px(found)
    assert max(errors_px) < 0.5
    assert found.uncertainty_px < 0.6
    assert max(errors_px) < 3 * found.uncertainty_px
    assert found.residual_px[0] < found.residual_px[1] < 1
    assert found.lens.fx == pytest.approx(room.lens.fx, rel=0.03)
    assert found.motion_px < 0.5
    assert found.warnings == ()
    assert len(set(stages)) == 3
    assert stages[-1] == "matching"
    world_to_thermal = found.viewmat(room.pairs[2].name, room.pairs[2].photo.camera.viewmat)
    expected = found.views[2].correction @ found.extrinsics @ room.pairs[2].photo.camera.viewmat
    assert torch.equal(world_to_thermal, expected)


@pytest.mark.slow
def test_a_stated_focal_length_is_believed_within_its_tolerance():
    room = build_room(views=3)
    found = [
        calibrate_rig(
            room.pairs,
            room.points,
            RigOptions(
                stated_field_of_view_deg=np.degrees(
                    2 * np.arctan(room.lens.width / (2 * stated * room.lens.fx))
                )
            ),
        ).lens.fx
        / room.lens.fx
        for stated in (1.0, 1.06)
    ]
    assert found[0] == pytest.approx(1, abs=0.01)
    assert found[0] + 0.01 < found[1] < 1.03


@pytest.mark.slow
def test_inverted_contrast_does_not_matter():
    room = build_room(views=3, inverted=True)
    found = calibrate_rig(room.pairs, room.points, KNOWN_FIELD)
    assert max(room.errors_px(found)) < 0.2


QUARTER = torch.tensor([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]).double()


def turned(pixels: Pixels) -> Pixels:
    """The pixels by a quarter turn anticlockwise, in which x is what y was."""
    return Pixels(pixels.values.rot90().contiguous(), None)


@pytest.mark.slow
def test_thermal_images_that_lie_on_their_side_are_placed(room):
    """A thermal camera that does not note how it was held, beside one that does."""
    pairs = [
        replace(pair, load_thermal=lambda pair=pair: turned(pair.load_thermal()))
        for pair in room.pairs
    ]
    own = room.lens
    lens = Lens(own.height, own.width, own.fy, own.fx, own.cy, own.width - own.cx, own.radial)
    truth = replace(room, pairs=pairs, lens=lens, extrinsics=QUARTER @ room.extrinsics)
    found = calibrate_rig(pairs, room.points, RigOptions(field_of_view_deg=44.0))
    assert max(truth.errors_px(found)) < 0.5
    assert found.warnings == ()


@pytest.mark.slow
def test_a_result_repeats(room):
    given = RigOptions(thermal_lens=room.lens, extrinsics=room.extrinsics)
    found, again = (calibrate_rig(room.pairs[:3], room.points, given) for _ in range(2))
    assert torch.equal(found.extrinsics, again.extrinsics)
    assert found.lens == again.lens


@pytest.mark.slow
def test_shutters_that_do_not_fire_together_are_corrected_and_told():
    room = build_room(views=4, motion_rad=0.012)
    found = calibrate_rig(room.pairs, room.points, KNOWN_FIELD)
    assert max(room.errors_px(found)) < 0.8
    (warning,) = found.warnings
    assert "camera moved" in warning


def test_a_given_lens_and_offset_stay_and_their_residual_is_told(room):
    given = RigOptions(thermal_lens=room.lens, extrinsics=room.extrinsics)
    found = calibrate_rig(room.pairs[:3], room.points, given)
    assert found.lens.fx == pytest.approx(room.lens.fx)
    assert found.lens.radial == pytest.approx(room.lens.radial)
    assert torch.allclose(found.extrinsics, room.extrinsics, atol=1e-6)
    assert max(room.errors_px(replace(found, views=found.views * 2))[:3]) < 0.5
    assert found.residual_px[0] < 1


@pytest.mark.slow
def test_unrelated_images_are_refused(room):
    rng = torch.Generator().manual_seed(0)
    noise = [Pixels(torch.rand(120, 160, 1, generator=rng)) for _ in range(3)]
    pairs = [
        replace(pair, load_thermal=lambda i=i: noise[i]) for i, pair in enumerate(room.pairs[:3])
    ]
    with pytest.raises(SceneError, match="by chance"):
        calibrate_rig(pairs, room.points, KNOWN_FIELD)


@pytest.mark.slow
def test_flat_thermal_images_are_refused(room):
    flat = Pixels(torch.full((120, 160, 1), 21.5))
    pairs = [replace(pair, load_thermal=lambda: flat) for pair in room.pairs[:3]]
    with pytest.raises(SceneError, match="by chance"):
        calibrate_rig(pairs, room.points, KNOWN_FIELD)
    given = RigOptions(thermal_lens=room.lens, extrinsics=room.extrinsics)
    with pytest.raises(SceneError, match="hardly any patch"):
        calibrate_rig(pairs, room.points, given)


@pytest.mark.slow
def test_an_uncertain_result_is_refused(room):
    strict = RigOptions(thermal_lens=room.lens, max_uncertainty_px=1e-3)
    with pytest.raises(SceneError, match=r"0\.\d px .* 0\.001 px"):
        calibrate_rig(room.pairs[:3], room.points, strict)


def test_too_few_points_are_told(room):
    few = PointCloud(room.points.positions[:5], room.points.colors[:5])
    with pytest.raises(SceneError, match="only 0 photos"):
        calibrate_rig(room.pairs, few)


def test_thermal_images_of_two_cameras_are_told(room):
    other = replace(room.pairs[1], load_thermal=lambda: Pixels(torch.rand(60, 80, 1)))
    with pytest.raises(SceneError, match=r"view_0 .*160×120 px, view_1 80×60"):
        calibrate_rig([room.pairs[0], other, *room.pairs[2:]], room.points)


def test_an_image_without_a_usable_pixel_is_told(room):
    blind = replace(
        room.pairs[1], load_thermal=lambda: Pixels(torch.full((120, 160, 1), float("nan")))
    )
    with pytest.raises(SceneError, match="no pixel of view_1"):
        calibrate_rig([room.pairs[0], blind], room.points)


def test_a_photo_that_sees_no_points_gets_the_rigs_motion_and_is_named(room):
    given = RigOptions(thermal_lens=room.lens, extrinsics=room.extrinsics)
    blind = replace(room.pairs[3], visible=torch.zeros(0, dtype=torch.int64))
    found = calibrate_rig([*room.pairs[:3], blind], room.points, given)
    assert torch.equal(found.views[3].correction, torch.eye(4, dtype=torch.float64))
    assert found.views[3].uncertainty_px == float("inf")
    (warning,) = found.warnings
    assert "too few points" in warning
    assert "view_3" in warning


def test_a_plain_pair_is_placed_by_the_others(room):
    given = RigOptions(thermal_lens=room.lens, extrinsics=room.extrinsics)
    flat = replace(room.pairs[3], load_thermal=lambda: Pixels(torch.full((120, 160, 1), 21.5)))
    found = calibrate_rig([*room.pairs[:2], flat], room.points, given)
    assert found.views[2].matches == 0
    others = [view.uncertainty_px for view in found.views[:2]]
    assert max(others) < found.views[2].uncertainty_px < given.max_uncertainty_px
    assert found.warnings == ()
    (name,) = [view.name for view in found.views if view.matches < FEWEST_MATCHES]
    summary = summarise_thermal_camera(found, RGB, True)
    assert name in summary.lines[-1]
    assert "rig alone" in summary.lines[-1]
    strict = (max(others) + found.views[2].uncertainty_px) / 2
    given = replace(given, max_uncertainty_px=strict)
    (warning,) = calibrate_rig([*room.pairs[:2], flat], room.points, given).warnings
    assert "few edges" in warning
    assert "(view_3)" in warning
