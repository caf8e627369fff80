from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest
import torch

from mrgs.data.radiometric import PhotoFacts
from mrgs.prepare.contract import (
    ConvertedPhotos,
    Pairing,
    PhotoPair,
    Reconstruction,
    Skipped,
    StageSummary,
)
from mrgs.prepare.rig.contract import RigCalibration, RigView, TargetFit
from mrgs.prepare.stages import (
    summarise_pairs,
    summarise_photos,
    summarise_poses,
    summarise_thermal_camera,
)
from mrgs.scene import RGB, THERMAL, PointCloud
from mrgs.scene.lens import Lens
from mrgs.scene.radiometry import ObjectParameters
from mrgs.scene.rotations import matrix_from_rotvec, rigid_transform
from tests.helpers.converted import converted_view

VIEW = converted_view(
    "a",
    {RGB: "images/a.jpg", THERMAL: "thermal/a.tiff"},
    facts=PhotoFacts("FLIR radiometric JPEG", camera="FLIR E60", warnings=("It is old.",)),
    range_c=(-3.04, 41.26),
)


def counts(summary: StageSummary) -> list[str]:
    """What the lines count: the number at the start of each, and its noun."""
    found = (re.match(r"\d+ \w+", line) for line in summary.lines)
    return [match[0] for match in found if match is not None]


def test_pairs_are_counted(tmp_path):
    pairs = (PhotoPair("a", {THERMAL: tmp_path / "a.jpg"}),)
    summary = summarise_pairs(
        Pairing(pairs, (Skipped("b", "is cut off"),), "By their names.", ("The clocks differ.",))
    )
    assert "By their names." in summary.lines[0]
    assert counts(summary) == ["1 photo", "1 file"]
    rgb = {RGB: tmp_path / "b.jpg", **pairs[0].photos}
    for pair in (replace(pairs[0], embedded=True), replace(pairs[0], photos=rgb)):
        assert counts(summarise_pairs(Pairing((pair,), (), "By names."))) == ["1 pair"]
    assert summary.warnings == ("The clocks differ.",)


def test_warnings_of_photos_are_said_once():
    facts = replace(VIEW.facts, warnings=("It is old.", "It is blurred."))
    other = replace(VIEW, name="b", facts=facts)
    summary = summarise_photos(
        ConvertedPhotos((VIEW, other), (Skipped("c", "is cut off"),), ("The distances differ.",))
    )
    assert counts(summary) == ["2 views", "1 pair"]
    assert "FLIR E60, −3.0 °C to 41.3 °C" in summary.lines[0]
    assert "not say with which emissivity" in summary.lines[1]
    all_photos, two, one = summary.warnings
    assert all_photos == "The distances differ."
    assert two.startswith("2 photos: ")
    assert one.startswith("b: ")


def test_photos_without_temperatures_are_said():
    grey = replace(VIEW, name="b", facts=PhotoFacts("PNG image"), range_c=None)
    (line,) = summarise_photos(ConvertedPhotos((grey,), ())).lines
    assert "no temperatures" in line
    line, _ = summarise_photos(ConvertedPhotos((VIEW, grey), ())).lines
    assert "1 without temperatures" in line


def test_the_settings_of_the_temperatures_are_said_and_whose_they_are():
    parameters = ObjectParameters(0.7, 1.0, -10.0, 20.0, 0.5)
    given = {"emissivity": 0.7, "reflected_c": -10.0}
    facts = replace(VIEW.facts, parameters=parameters, given=given)
    other = replace(facts, parameters=replace(parameters, distance_m=2.5))
    views = (replace(VIEW, facts=facts), replace(VIEW, name="b", facts=other))
    line = summarise_photos(ConvertedPhotos(views, ())).lines[1]
    for setting in (
        "emissivity 0.70 (given",
        "reflected temperature −10.0 °C (given",
        "distance 1.0 to 2.5 m,",
        "air temperature 20.0 °C,",
        "humidity 0.50",
    ):
        assert setting in line


def test_poses_say_how_well_they_fit():
    found = Reconstruction(
        {}, {}, PointCloud(torch.zeros(0, 3), torch.zeros(0, 3)), None, (), None, "Found."
    )
    assert summarise_poses(found).lines == ("Found.",)
    failed = replace(
        found, reprojection_px=0.456, failed=(Skipped("a", "blurred"), Skipped("b", "blurred"))
    )
    assert "0.46 px" in summarise_poses(failed).lines[0]
    assert counts(summarise_poses(failed)) == ["2 images"]


def calibration(turn_deg: float = 0.0) -> RigCalibration:
    """A thermal camera 3 cm beside the RGB camera, turned about the optical axis."""
    pose = rigid_transform(matrix_from_rotvec([0.0, 0.0, math.radians(turn_deg)]), [0.03, 0.0, 0.0])
    lens = Lens(640, 480, 640.0, 640.0, 320.0, 240.0)
    views = (RigView("a", pose, 50, 0.1, 0.2),)
    return RigCalibration(lens, pose, views, (0.28, 0.5), 0.36, 0.1, ("Hold still.",))


@pytest.mark.parametrize(("turn_deg", "said"), [(93, 90), (-88, 90), (178, 180), (-179, 180)])
def test_a_thermal_camera_on_its_side_is_said(turn_deg, said):
    _, line = summarise_thermal_camera(calibration(turn_deg), RGB, True).lines
    assert f" {said}° " in line


@pytest.mark.parametrize(
    ("metric", "per_unit", "offset", "more"),
    [
        (True, None, "3.0 cm", ()),
        (False, None, "0.03 scene units", ()),
        (False, 2.0, "6.0 cm", ("in metres",)),
        (True, 1.02, "3.0 cm", ()),
        (True, 2.0, "3.0 cm", ()),
    ],
)
def test_the_thermal_camera_is_said_in_degrees_and_lengths(metric, per_unit, offset, more):
    rig = calibration()
    if per_unit is not None:
        rig = replace(rig, target=TargetFit(5, (0.1, 0.2), per_unit))
        more = ("5 pairs; residual 0.10 px", *more)
    summary = summarise_thermal_camera(rig, RGB, metric)
    line, *others = summary.lines
    for told in ("53.1°", offset, "residual 0.28 px", "±0.36 px"):
        assert told in line
    for told, other in zip(more, others, strict=True):
        assert told in other
    contradicts = metric and per_unit == 2.0
    assert summary.warnings[0] == "Hold still."
    assert len(summary.warnings) == 1 + contradicts
    assert not contradicts or "2.00 times" in summary.warnings[1]


def test_without_a_second_camera_that_is_said():
    for modality, told in ((RGB, "One camera"), (THERMAL, "only thermal")):
        (line,) = summarise_thermal_camera(None, modality, True).lines
        assert told in line
