"""Control points, check points and scale bars: read, fitted, and what is refused."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from mrgs.data import load_scene
from mrgs.data.radiometric import GpsPosition
from mrgs.errors import SceneError
from mrgs.maps.crs import coordinate_system
from mrgs.prepare.contract import Georeference, Reconstruction, rms_m
from mrgs.prepare.control import (
    ControlPoint,
    ControlPoints,
    at_chequers,
    place_by_control,
    read_control,
)
from mrgs.prepare.georeference import apply, centres, georeference
from mrgs.prepare.rig.chessboard import saddle_near
from mrgs.scene import PointCloud, WorldFrame
from mrgs.scene.lens import Lens
from mrgs_synth.cameras import look_at

LENS = Lens(400, 300, 300.0, 300.0, 200.0, 150.0, (-0.1, 0.02, 0.0, 0.0))
EYES = np.array([[4.0 * np.cos(t), -9 + np.sin(t), 2 + np.sin(3 * t)] for t in np.arange(8.0)])
PLACES = {
    "A": (-3.0, 0.2, 0.5),
    "B": (3.0, -0.4, 0.3),
    "C": (2.5, 0.0, 3.5),
    "D": (-2.0, 0.8, 3.0),
    "K": (0.5, 0.4, 1.5),
}
"""Metres; K is a check point."""

UTM = np.array([691000.0, 5334000.0, 520.0])
"""Munich, in EPSG:32632."""

PHOTOS = {f"v{i}.jpg": (f"v{i}", (400, 300)) for i in range(8)}


def wall() -> Reconstruction:
    """Eight cameras that look north at places a few metres wide; z is up."""
    aim = np.array([0.0, 0.0, 1.5])
    viewmats = {f"v{i}": torch.from_numpy(look_at(eye, aim)) for i, eye in enumerate(EYES)}
    cloud = PointCloud(torch.zeros(1, 3), torch.zeros(1, 3))
    return Reconstruction(viewmats, dict.fromkeys(viewmats, LENS), cloud, None, (), None, "made up")


def displaced(truth: Reconstruction) -> Reconstruction:
    turn = torch.from_numpy(Rotation.from_euler("xyz", [0.4, -0.3, 1.1]).as_matrix())
    shift = torch.tensor([3.0, -1.0, 0.5], dtype=torch.float64)
    return apply(Georeference(0.31, turn, shift, False, False, None, None, ""), truth)


def marks(place: Sequence[float], noise_px: float = 0.0) -> dict[str, tuple[float, float]]:
    """The place's pixels in all photos."""
    found, rng = {}, np.random.default_rng([int(1000 * abs(axis)) for axis in place])
    for view, viewmat in wall().viewmats.items():
        x, y, z = viewmat.numpy()[:3, :3] @ np.array(place) + viewmat.numpy()[:3, 3]
        u, v = LENS.distort(np.array([x / z]), np.array([y / z]))
        pixel = np.array([u[0] * LENS.fx + LENS.cx, v[0] * LENS.fy + LENS.cy])
        found[view] = tuple((pixel + noise_px * rng.normal(size=2)).tolist())
    return found


def surveyed(names: str = "ABCDK", noise_px: float = 0.0, **changed) -> ControlPoints:
    places = {name: changed.get(name, PLACES[name]) for name in names}
    points = {
        name: ControlPoint(marks(PLACES[name], noise_px), place, name == "K")
        for name, place in places.items()
    }
    return ControlPoints(points)


def test_control_points_give_metres_and_axes():
    found, placed = place_by_control(displaced(wall()), surveyed(noise_px=0.3), {})
    assert placed.metric
    assert placed.north
    assert placed.offset is None
    moved = centres(apply(placed, found), wall().viewmats)
    assert moved == pytest.approx(EYES, abs=0.05)
    assert [each.name for each in placed.control] == ["A", "B", "C", "D", "K"]
    assert [each.role for each in placed.control] == [*["control"] * 4, "check"]
    check = placed.control[-1]
    assert check.off_m == pytest.approx(np.linalg.norm(check.shift_m))
    assert 0.001 < check.off_m < 0.02
    assert 0.2 < check.error_px < 0.6
    assert check.photos == 8
    assert placed.world.control_m == rms_m(placed.control, "check") == check.off_m
    assert "the axes east, north, up." in placed.text
    assert f"RMS of check points: {100 * check.off_m:.2g} cm" in placed.text


def targets(view: str, names: str = "ABCDK", radius_px: float = 7.0) -> np.ndarray:
    """A view's image with a round chequer target at each place, turned and sheared."""
    rng = np.random.default_rng([int(view[1:]), 1])
    fine = 5
    y, x = (np.mgrid[: 300 * fine, : 400 * fine] + 0.5) / fine
    image = 90 + 4 * rng.normal(size=(300, 400)).repeat(fine, 0).repeat(fine, 1)
    for name in names:
        u, v = marks(PLACES[name])[view]
        turn, lean = rng.uniform(0, np.pi), rng.uniform(1.2, 1.9)
        a = np.cos(turn) * (x - u) + np.sin(turn) * (y - v)
        b = np.cos(turn + lean) * (x - u) + np.sin(turn + lean) * (y - v)
        near = np.hypot(x - u, y - v) < radius_px
        image[near] = np.where(a * b > 0, 210, 35)[near]
    image = image.reshape(300, fine, 400, fine).mean(axis=(1, 3))
    return gaussian_filter(image, 0.6).astype(np.float32)


def test_marks_of_chequer_targets_are_moved_to_their_middle():
    rough = surveyed(noise_px=1.2)
    for point in rough.points.values():
        point.chequer = True
    found, warnings = at_chequers(rough, targets)
    assert not warnings
    exact = np.array([[*marks(place).values()] for place in PLACES.values()])
    moved = np.array([[*point.marks.values()] for point in found.points.values()])
    assert np.linalg.norm(moved - exact, axis=-1).max() < 0.15
    check_m = [
        place_by_control(displaced(wall()), each, {})[1].control[-1].off_m
        for each in (rough, found)
    ]
    assert check_m[1] < check_m[0] / 5


@pytest.mark.parametrize("blur_px", [0.8, 1.5, 3.0])
def test_texture_is_no_chequer_target(blur_px):
    rng = np.random.default_rng(0)
    images = gaussian_filter(rng.normal(size=(40, 120, 120)), (0, blur_px, blur_px))
    found = [saddle_near(30 * image, np.array([60.0, 60.0]), 8.0) for image in images]
    assert sum(each is not None for each in found) <= 3


def test_of_the_corners_of_a_board_the_nearest_is_meant():
    y, x = np.mgrid[:120, :120] // 12
    board = gaussian_filter(100.0 * ((x + y) % 2), 0.7)
    found = saddle_near(board, np.array([60.7, 47.6]), 8.0)
    assert found == pytest.approx((60.0, 48.0), abs=0.1)


def test_a_target_is_found_beside_invalid_pixels_and_in_16_bits():
    image = targets("v0", "A")
    (u, v) = marks(PLACES["A"])["v0"]
    image = 30_000 + 0.05 * image
    image[int(v) - 9, int(u) - 12] = np.nan
    found = saddle_near(image, np.array([u + 1.5, v - 1]), 4.0)
    assert found == pytest.approx((u, v), abs=0.2)


def test_a_mark_beside_no_chequer_target_counts_as_it_is():
    control = surveyed("AK")
    control.points["A"].chequer = True
    found, warnings = at_chequers(control, lambda view: targets(view, "K" if view == "v3" else "A"))
    assert warnings == ("A is not a chequer target in v3: its mark there counts as it is.",)
    assert found.points["A"].marks["v3"] == control.points["A"].marks["v3"]
    assert found.points["A"].marks["v2"] != control.points["A"].marks["v2"]
    assert found.points["K"] == control.points["K"]


def test_residuals_are_found_minus_stated_along_the_axes():
    _, placed = place_by_control(displaced(wall()), surveyed(K=(0.4, 0.4, 1.7)), {})
    assert placed.control[-1].shift_m == pytest.approx((0.1, 0.0, -0.2), abs=1e-6)
    assert placed.control[0].off_m == pytest.approx(0, abs=1e-6)


def test_large_local_coordinates_get_an_origin_nearby():
    moved = {name: tuple(UTM + place) for name, place in PLACES.items()}
    found, placed = place_by_control(displaced(wall()), surveyed(**moved), {})
    assert placed.offset == (691000.0, 5334000.0, 500.0)
    assert placed.origin is None
    assert placed.world.north
    places = centres(apply(placed, found), wall().viewmats)
    assert np.abs(places).max() < 100
    assert places + placed.offset == pytest.approx(EYES + UTM, abs=1e-6)


def test_coordinates_in_a_crs_place_the_scene_on_earth(make_scene):
    pytest.importorskip("pyproj")
    moved = {name: tuple(UTM + place) for name, place in PLACES.items()}
    control = replace(surveyed(**moved), crs="EPSG:32632")
    _, placed = place_by_control(displaced(wall()), control, {})
    assert placed.world.is_georeferenced
    assert placed.offset is None
    assert placed.origin.latitude_deg == pytest.approx(48.13, abs=0.05)
    assert placed.origin.altitude_m == pytest.approx(521.76, abs=0.01)
    assert placed.control[-1].off_m < 0.003  # metres of UTM are 0.01 % off those on the ground
    scene = replace(load_scene(make_scene()), world=placed.world)
    places = centres(apply(placed, displaced(wall())), wall().viewmats)
    assert coordinate_system(scene, "EPSG:32632").apply(places) == pytest.approx(
        EYES + UTM, abs=0.005
    )


def test_a_crs_that_gps_contradicts_is_told():
    pytest.importorskip("pyproj")
    moved = {name: tuple(UTM + place) for name, place in PLACES.items()}
    control = replace(surveyed(**moved), crs="EPSG:32633")  # the next zone's
    gps = {f"v{i}": GpsPosition(48.13, 11.57, 520.0) for i in range(8)}
    _, placed = place_by_control(displaced(wall()), control, gps)
    (warning,) = placed.warnings
    assert re.search(r"GPS puts the photos 4\d\d km away: check the CRS", warning)
    _, placed = place_by_control(displaced(wall()), replace(control, crs="EPSG:32632"), gps)
    assert placed.warnings == ()


def test_gps_is_overridden():
    gps = {f"v{i}": GpsPosition(48.0 + 0.01 * i, 11.0, 500.0) for i in range(8)}
    _, placed = place_by_control(displaced(wall()), surveyed(), gps)
    assert placed.residual_m is None
    assert placed.control[-1].off_m < 1e-6


def test_a_control_point_that_is_off_by_more_than_the_others_is_named():
    places = {**PLACES, "E": (0.0, 0.5, 4.0)}
    points = {name: ControlPoint(marks(place, 0.3), place) for name, place in places.items()}
    _, placed = place_by_control(displaced(wall()), ControlPoints(points), {})
    assert placed.warnings == ()
    points["C"].place = (2.62, 0.0, 3.5)
    _, placed = place_by_control(displaced(wall()), ControlPoints(points), {})
    (warning,) = placed.warnings
    assert warning.startswith("C is ")
    assert "check its coordinates and marks" in warning


def test_scale_bars_give_the_scale_alone():
    length = float(np.linalg.norm(np.subtract(PLACES["A"], PLACES["B"])))
    points = {name: ControlPoint(marks(PLACES[name])) for name in "AB"}
    control = ControlPoints(points, [("A", "B", length)])
    found, placed = place_by_control(displaced(wall()), control, {})
    assert placed.metric
    assert not placed.north
    moved = centres(apply(placed, found), wall().viewmats)
    assert np.linalg.norm(moved[0] - moved[5]) == pytest.approx(np.linalg.norm(EYES[0] - EYES[5]))
    assert placed.text.startswith("The scale is that of the stated length.")
    assert placed.control == ()  # one length fits itself


def test_several_scale_bars_disagree_by_what_is_told():
    points = {name: ControlPoint(marks(PLACES[name])) for name in "ABCD"}
    true = [float(np.linalg.norm(np.subtract(PLACES[a], PLACES[b]))) for a, b in ("AB", "CD")]
    bars = [("A", "B", true[0] + 0.03), ("C", "D", true[1] - 0.03)]
    _, placed = place_by_control(displaced(wall()), ControlPoints(points, bars), {})
    assert [each.name for each in placed.control] == ["A – B", "C – D"]
    assert placed.control[0].off_m < -0.02 < 0.02 < placed.control[1].off_m
    assert "RMS of stated lengths: 3" in placed.text


def test_lengths_beside_control_points_are_checks():
    control = surveyed()
    control.bars.append(("A", "B", 5.0))
    _, placed = place_by_control(displaced(wall()), control, {})
    assert placed.control[-1].off_m == pytest.approx(np.linalg.norm([6, 0.6, 0.2]) - 5, abs=1e-6)
    assert placed.control[-1].role == "length"


def test_two_control_points_give_the_scale_and_say_so():
    _, placed = place_by_control(displaced(wall()), surveyed("AB"), {})
    assert placed.metric
    assert not placed.north
    assert any("2 control points give no axes" in text for text in placed.warnings)


def test_given_poses_are_turned_and_scaled():
    found, placed = place_by_control(displaced(wall()), surveyed(), {}, as_given=True)
    assert centres(apply(placed, found), wall().viewmats) == pytest.approx(EYES, abs=1e-6)


def test_marks_without_a_pose_are_left_out_and_named():
    control = surveyed()
    control.points["A"].marks["lost"] = (1.0, 1.0)
    control.points["D"].marks = {"v0": control.points["D"].marks["v0"]}
    control.points["E"] = ControlPoint({}, (1.0, 2.0, 3.0))
    _, placed = place_by_control(displaced(wall()), control, {})
    assert placed.warnings == (
        "A is marked in lost, without a pose.",
        "D is not used: mark it in two photos, from different places.",
        "E is not used: mark it in two photos, from different places.",
    )
    assert [each.name for each in placed.control] == ["A", "B", "C", "K"]
    assert placed.control[0].photos == 8


def contradicting() -> ControlPoints:
    return surveyed(C=(4.5, 0.0, 3.5))


def wrong_mark() -> ControlPoints:
    control = surveyed()
    control.points["B"].marks["v3"] = (10.0, 10.0)
    return control


@pytest.mark.parametrize(
    ("control", "told"),
    [
        (surveyed("A"), "1 control point can be used; mark 3, each in two photos"),
        (surveyed("K"), "0 control points can be used"),
        (
            surveyed(B=(0.0, 0.2, 0.5), C=(3.0, 0.2, 0.5), D=(5.0, 0.2, 0.51)),
            "lie on a line",
        ),
        (contradicting(), r"contradict each other: C is 2(\.\d)? m off the others; correct"),
        (surveyed("ABC", C=(4.5, 0.0, 3.5)), r"contradict each other: A, B, C fit to 0\.\d+ m"),
        (wrong_mark(), r"the marks of B do not meet: that in v3 is \d+ px off; correct"),
        (surveyed(**{n: (y, x, -z) for n, (x, y, z) in PLACES.items()}), "upside down"),
    ],
)
def test_control_points_that_cannot_be_used(control, told):
    with pytest.raises(SceneError, match=told) as error:
        place_by_control(displaced(wall()), control, {})
    assert error.value.options == ("control",)


def test_swapped_columns_are_recognised():
    deep = {"A": (-3.0, 4.0, 0.5), "B": (3.0, -2.0, 0.3), "C": (2.5, 5.0, 3.5), "D": (-2.0, 0, 3)}
    points = {name: ControlPoint(marks(p), (p[1], p[0], p[2])) for name, p in deep.items()}
    with pytest.raises(SceneError, match=r"contradict each other.*; swap east and north"):
        place_by_control(displaced(wall()), ControlPoints(points), {})


def test_a_crs_that_is_elsewhere_is_refused():
    pytest.importorskip("pyproj")
    moved = {n: (UTM[1] + y, UTM[0] + x, z) for n, (x, y, z) in PLACES.items()}
    with pytest.raises(SceneError, match=r"not where .*32N is for; .*swap east and north"):
        place_by_control(wall(), replace(surveyed(**moved), crs="EPSG:32632"), {})
    with pytest.raises(SceneError, match="unknown CRS"):
        place_by_control(wall(), replace(surveyed(**moved), crs="EPSG:1"), {})
    with pytest.raises(SceneError, match="not a projected CRS"):
        place_by_control(wall(), replace(surveyed(**moved), crs="EPSG:4326"), {})


def test_two_points_in_one_place_give_no_scale():
    with pytest.raises(SceneError, match="A and B are in one place"):
        place_by_control(wall(), surveyed("AB", B=PLACES["A"]), {})


def test_given_poses_stay_in_the_frame_of_a_survey():
    world = WorldFrame(True, True, offset=(691_000.0, 5_334_000.0, 500.0), control_m=0.012)
    placed = georeference(replace(wall(), world=world), {}, as_given=True)
    assert placed.world == world


HEADING = "name,east,north,height,view,x,y,role,crs,to,length\n"


def read(tmp_path: Path, text: str) -> ControlPoints:
    file = tmp_path / "points.csv"
    file.write_text(text, encoding="utf-8")
    return read_control(file, PHOTOS)


def test_a_table_of_observations(tmp_path):
    found = read(
        tmp_path,
        f"# of June\n{HEADING}# by hand\nP1,1.5,2,-3,v0.jpg,10,20.5\nP1,,,,V1.JPG,11,21\n"
        f"K,4,5,6,v0.jpg,1,1,check,EPSG:25832\nE,,,,v2.jpg,3,3\nP1,,,,,,,,,E,2.5\n",
    )
    assert found.points["P1"] == ControlPoint(
        {"v0": (10.0, 20.5), "v1": (11.0, 21.0)}, (1.5, 2.0, -3.0)
    )
    assert found.points["K"].check
    assert found.points["E"].place is None
    assert found.bars == [("P1", "E", 2.5)]
    assert found.crs == "EPSG:25832"


def test_a_table_with_decimal_commas(tmp_path):
    found = read(tmp_path, "name;east;north;height;view;x;y\nP;1,25;2;3;v0.jpg;10,5;20\n")
    assert found.points["P"] == ControlPoint({"v0": (10.5, 20.0)}, (1.25, 2.0, 3.0))


@pytest.mark.parametrize("separator", [" ", "\t"])
def test_a_gcp_list(tmp_path, separator):
    lines = [
        "WGS84 UTM 32N",
        "691000 5334000 520 10 20 v0.jpg gcp1",
        "691000 5334000 520 1 2 v1.jpg",
    ]
    lines[2] += " gcp1"
    found = read(tmp_path, lines[0] + "\n" + "\n".join(lines[1:]).replace(" ", separator))
    assert found.crs == "WGS 84 / UTM zone 32N"
    assert found.points == {
        "gcp1": ControlPoint({"v0": (10.0, 20.0), "v1": (1.0, 2.0)}, tuple(UTM))
    }


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ("P,1,2,x,v0.jpg,1,1", "line 2: height is 'x'"),
        ("P,nan,2,3,v0.jpg,1,1", "line 2: east is 'nan'"),
        ("P,1,2,inf,v0.jpg,1,1", "line 2: height is 'inf'"),
        ("P,1,2,3,v0.jpg,1,1\nP,1,2,4,v1.jpg,1,1", "line 3: P lacks a coordinate, or has others"),
        ("P,1,2,,v0.jpg,1,1", "line 2: P lacks a coordinate"),
        ("P,1,2,3,v9.jpg,1,1", "line 2: none of the photos in use, .* has the name 'v9.jpg'"),
        ("P,,,,,,,,,P,1", "line 2: a scale bar needs name, to and length"),
        ("# no points yet", "it has no points; write name"),
        ("P,1,2,3,v0.jpg,401,1", "line 2: the mark is not in v0.jpg, 400×300 px"),
        ("P,1,2,3,v0.jpg,1,-1", "line 2: the mark is not in v0.jpg"),
        ("P,1,2,3,v0.jpg,1", "line 2: the mark is not in v0.jpg"),
        ("P,1,2,3,v0.jpg,1,1\nP,,,,v0.jpg,2,2", "line 3: P is marked in v0.jpg twice"),
        ("P,1,2,3,v0.jpg,1,1,maybe", "line 2: role is 'maybe'"),
        ("P,,,,,,,,,Q", "line 2: a scale bar needs name, to and length"),
        ("P,,,,,,,,,Q,0", "line 2: length is '0'"),
        ("P,,,,v0.jpg,1,1\nP,,,,,,,,,Q,2", "Q needs a line with pixels"),
        ("P,,,,v0.jpg,1,1", "P needs coordinates or a scale bar"),
        ("P,1,2,3,v0.jpg,1,1,,A\nP,,,,v1.jpg,1,1,,B", "line 3: the CRS is B, and A above"),
        (
            "P,11.57501,48.13701,3,v0.jpg,1,1\nQ,11.57502,48.13702,3,v0.jpg,2,2",
            "look like degrees; give metres",
        ),
    ],
)
def test_tables_that_cannot_be_read(tmp_path, rows, told):
    with pytest.raises(SceneError, match=told) as error:
        read(tmp_path, HEADING + rows + "\n")
    assert "points.csv" in str(error.value)


def test_a_table_without_headings(tmp_path):
    with pytest.raises(SceneError, match="first line names no columns; write name,east"):
        read(tmp_path, "P,1,2,3,v0.jpg,1,1\n")
