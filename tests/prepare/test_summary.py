from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from mrgs.data.lens import Lens
from mrgs.data.radiometric import PhotoFacts
from mrgs.prepare.contract import (
    ConvertedPhotos,
    Pairing,
    PhotoPair,
    Reconstruction,
    Skipped,
)
from mrgs.prepare.rig.contract import RigCalibration, RigView, TargetFit
from mrgs.prepare.summary import (
    summarize_pairs,
    summarize_photos,
    summarize_poses,
    summarize_thermal_camera,
)
from mrgs.scene import RGB, THERMAL, PointCloud
from mrgs.scene.radiometry import ObjectParameters
from mrgs.scene.rotations import matrix_from_rotvec, rigid_transform
from tests.helpers.converted import converted_view

VIEW = converted_view(
    "a",
    {RGB: "images/a.jpg", THERMAL: "thermal/a.tiff"},
    facts=PhotoFacts("FLIR radiometric JPEG", camera="FLIR E60", warnings=("It is old.",)),
    range_c=(-3.04, 41.26),
)

NO_SETTINGS = (
    "The photos' files do not say with which emissivity, reflected temperature and distance the "
    "temperatures were computed."
)


def test_pairs_are_counted(tmp_path):
    pairs = (PhotoPair("a", {THERMAL: tmp_path / "a.jpg"}),)
    summary = summarize_pairs(
        Pairing(pairs, (Skipped("b", "is cut off"),), "By their names.", ("The clocks differ.",))
    )
    assert summary.lines == ("1 photo. By their names.", "1 file skipped.")
    rgb = {RGB: tmp_path / "b.jpg", **pairs[0].photos}
    for pair in (replace(pairs[0], embedded=True), replace(pairs[0], photos=rgb)):
        assert summarize_pairs(Pairing((pair,), (), "By names.")).lines == ("1 pair. By names.",)
    assert summary.warnings == ("The clocks differ.",)


def test_warnings_of_photos_are_said_once(tmp_path):
    facts = replace(VIEW.facts, warnings=("It is old.", "It is blurred."))
    other = replace(VIEW, name="b", facts=facts)
    summary = summarize_photos(
        ConvertedPhotos((VIEW, other), (Skipped("c", "is cut off"),), ("The distances differ.",))
    )
    assert summary.lines == (
        "2 views, FLIR E60, −3.0 °C to 41.3 °C.", NO_SETTINGS, "1 pair skipped.",
    )  # fmt: skip
    assert summary.warnings == (
        "The distances differ.",
        "2 photos: It is old.",
        "b: It is blurred.",
    )


def test_photos_without_temperatures_are_said():
    grey = replace(VIEW, name="b", facts=PhotoFacts("PNG image"), range_c=None)
    assert summarize_photos(ConvertedPhotos((grey,), ())).lines == ("1 view, no temperatures.",)
    assert summarize_photos(ConvertedPhotos((VIEW, grey), ())).lines == (
        "2 views, FLIR E60, −3.0 °C to 41.3 °C, 1 without temperatures.", NO_SETTINGS,
    )  # fmt: skip


def test_the_settings_of_the_temperatures_are_said_and_whose_they_are():
    parameters = ObjectParameters(0.7, 1.0, -10.0, 20.0, 0.5)
    given = {"emissivity": 0.7, "reflected_c": -10.0}
    facts = replace(VIEW.facts, parameters=parameters, given=given)
    other = replace(facts, parameters=replace(parameters, distance_m=2.5))
    views = (replace(VIEW, facts=facts), replace(VIEW, name="b", facts=other))
    assert summarize_photos(ConvertedPhotos(views, ())).lines[1] == (
        "Temperatures computed with emissivity 0.70 (given by you), reflected temperature "
        "−10.0 °C (given by you), distance 1.0 to 2.5 m, air temperature 20.0 °C, relative "
        "humidity 0.50."
    )


def test_poses_say_how_well_they_fit():
    found = Reconstruction(
        {}, {}, PointCloud(torch.zeros(0, 3), torch.zeros(0, 3)), None, (), None, "Found."
    )
    assert summarize_poses(found).lines == ("Found.",)
    failed = replace(
        found, reprojection_px=0.456, failed=(Skipped("a", "blurred"), Skipped("b", "blurred"))
    )
    assert summarize_poses(failed).lines == (
        "Found. Reprojection error 0.46 px.",
        "2 images without a pose.",
    )


def calibration(turn_deg: float = 0.0) -> RigCalibration:
    """A thermal camera 3 cm beside the RGB camera, turned about the optical axis."""
    turn = torch.from_numpy(matrix_from_rotvec([0.0, 0.0, math.radians(turn_deg)]))
    pose = rigid_transform(turn, torch.tensor([0.03, 0.0, 0.0], dtype=torch.float64))
    lens = Lens(640, 480, 640.0, 640.0, 320.0, 240.0)
    views = (RigView("a", pose, 5, 0.1, 0.2),)
    return RigCalibration(lens, pose, views, (0.28, 0.5), 0.36, 0.1, ("Hold still.",))


@pytest.mark.parametrize(("turn_deg", "said"), [(93, 90), (-88, 90), (178, 180), (-179, 180)])
def test_a_thermal_camera_on_its_side_is_said(turn_deg, said):
    assert summarize_thermal_camera(calibration(turn_deg), RGB, True).lines[1:] == (
        f"The thermal images are turned by about {said}° relative to the RGB images; the offset "
        "includes this turn.",
    )


@pytest.mark.parametrize(
    ("metric", "per_unit", "offset", "more"),
    [
        (True, None, "3.0 cm", ()),
        (False, None, "0.03 scene units", ()),
        (False, 2.0, "6.0 cm", ("The target gives the scale: the scene is in metres.",)),
        (True, 1.02, "3.0 cm", ()),
        (True, 2.0, "3.0 cm", ()),
    ],
)
def test_the_thermal_camera_is_said_in_degrees_and_lengths(metric, per_unit, offset, more):
    rig = calibration()
    if per_unit is not None:
        rig = replace(rig, target=TargetFit(5, 5, (0.1, 0.2), per_unit))
        more = ("The target is in 5 pairs; residual 0.10 px.", *more)
    summary = summarize_thermal_camera(rig, RGB, metric)
    assert summary.lines == (
        f"53.1° wide, {offset} from the RGB camera; residual 0.28 px, uncertainty ±0.36 px.",
        *more,
    )
    contradicts = metric and per_unit == 2.0
    assert summary.warnings[0] == "Hold still."
    assert len(summary.warnings) == 1 + contradicts
    assert not contradicts or summary.warnings[1].startswith(
        "The target's squares make the scene 2.00 times"
    )


def test_without_a_second_camera_that_is_said():
    assert summarize_thermal_camera(None, RGB, True).lines == ("One camera took both images.",)
    alone = summarize_thermal_camera(None, THERMAL, True)
    assert alone.lines == ("There are only thermal images.",)
