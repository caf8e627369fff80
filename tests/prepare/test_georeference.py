from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mrgs.data.earth import SEMI_MAJOR_AXIS_M, enu
from mrgs.data.radiometric import GpsPosition
from mrgs.errors import SceneError
from mrgs.prepare.contract import Georeference, Reconstruction
from mrgs.prepare.georeference import KnownDistance, apply, centres, georeference, up_of_cameras
from mrgs.scene import EarthPosition, PointCloud, WorldFrame
from mrgs.scene.lens import Lens
from mrgs_synth.cameras import look_at

LENS = Lens(400, 300, 300.0, 300.0, 200.0, 150.0, (-0.1, 0.02, 0.0, 0.0))
PLACE = GpsPosition(48.137, 11.575, 520.0)
METRES_PER_DEGREE = math.radians(1) * SEMI_MAJOR_AXIS_M


def around(radius: float = 20.0, count: int = 12) -> np.ndarray:
    """Positions on two circles."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    heights = np.where(np.arange(count) % 2, 0.2, 0.5) * radius
    return np.column_stack([radius * np.cos(angles), radius * np.sin(angles), heights])


def reconstruction_of(positions: np.ndarray, points: np.ndarray | None = None) -> Reconstruction:
    """Cameras that look at the origin, in metres, z up; all see all points."""
    if points is None:
        points = np.random.default_rng(0).uniform(-3, 3, (400, 3))
    names = [f"view_{index}" for index in range(len(positions))]
    cloud = PointCloud(torch.from_numpy(points).float(), torch.full((len(points), 3), 0.5))
    viewmats = {
        name: torch.from_numpy(look_at(position, np.zeros(3)))
        for name, position in zip(names, positions, strict=True)
    }
    visible = {name: torch.arange(len(points)) for name in names}
    return Reconstruction(viewmats, dict.fromkeys(names, LENS), cloud, visible, (), None, "made up")


def displaced(truth: Reconstruction, seed: int) -> Reconstruction:
    """The same in a world that was turned, moved and scaled."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=rng).as_matrix()
    scale, shift = float(rng.uniform(0.05, 2)), torch.from_numpy(rng.normal(0, 3, 3))
    return apply(
        Georeference(scale, torch.from_numpy(turn), shift, False, False, None, None, ""), truth
    )


def gps_of(positions: np.ndarray, height: bool = True) -> dict[str, GpsPosition]:
    """EXIF positions of cameras whose places are given in metres about ``PLACE``, to about a
    millimetre near it."""
    east_scale = METRES_PER_DEGREE * math.cos(math.radians(PLACE.latitude_deg))
    places = {}
    for index, (east, north, up) in enumerate(positions):
        guess = np.array(
            [
                PLACE.latitude_deg + north / METRES_PER_DEGREE,
                PLACE.longitude_deg + east / east_scale,
            ]
        )
        for _ in range(3):  # the ellipsoid is no sphere
            miss = enu([GpsPosition(*guess, 520.0 + up)], PLACE)[0] - [east, north, up]
            guess -= [miss[1] / METRES_PER_DEGREE, miss[0] / east_scale]
        places[f"view_{index}"] = GpsPosition(
            float(guess[0]), float(guess[1]), 520.0 + float(up) if height else None
        )
    return places


def shape_of(reconstruction: Reconstruction) -> np.ndarray:
    """The cameras' places about their mean."""
    places = centres(reconstruction, reconstruction.viewmats)
    return places - places.mean(axis=0)


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_gps_gives_metres_and_north(seed):
    positions = around()
    truth = reconstruction_of(positions)
    noisy = positions + np.random.default_rng(seed).normal(0, 0.5, positions.shape)
    found = georeference(displaced(truth, seed), gps_of(noisy))
    assert found.metric
    assert found.north
    assert found.origin is not None
    assert found.residual_m == pytest.approx(0.75, abs=0.5)
    assert "axes east, north, up" in found.text
    moved = apply(found, displaced(truth, seed))
    assert shape_of(moved) == pytest.approx(shape_of(truth), abs=1.5)


def test_the_error_of_the_scale_holds_that_of_most_flights():
    """In 95 of 100 the scale is within twice its standard uncertainty."""
    positions, held = around(), []
    for seed in range(100):
        noisy = positions + np.random.default_rng(seed).normal(0, 0.5, positions.shape)
        moved = displaced(reconstruction_of(positions), seed)
        found = georeference(moved, gps_of(noisy))
        size = np.linalg.norm(found.scale * shape_of(moved)) / np.linalg.norm(
            positions - positions.mean(axis=0)
        )
        held.append(abs(size - 1) <= 2 * found.scale_error)
    assert 0.93 <= np.mean(held) <= 0.99


def test_apply_moves_points_as_it_moves_cameras():
    truth = reconstruction_of(around())
    moved = displaced(truth, 3)
    for name, viewmat in truth.viewmats.items():
        before = truth.points.positions.double() @ viewmat[:3, :3].T + viewmat[:3, 3]
        own = moved.viewmats[name]
        after = moved.points.positions.double() @ own[:3, :3].T + own[:3, 3]
        assert after[:, :2] / after[:, 2:] == pytest.approx(before[:, :2] / before[:, 2:], abs=1e-4)
        assert own[:3, :3] @ own[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)


def test_wrong_positions_are_left_out_and_counted():
    positions = around()
    wrong = positions.copy()
    wrong[[2, 7]] += [80.0, -30.0, 5.0]
    found = georeference(displaced(reconstruction_of(positions), 1), gps_of(wrong))
    (warning,) = found.warnings
    assert "2 of 12" in warning
    assert "left out" in warning
    assert shape_of(apply(found, displaced(reconstruction_of(positions), 1))) == pytest.approx(
        shape_of(reconstruction_of(positions)), abs=0.01
    )


def test_without_heights_the_cameras_tell_the_vertical():
    truth = reconstruction_of(around())
    found = georeference(displaced(truth, 5), gps_of(around(), height=False))
    assert found.north
    (warning,) = found.warnings
    assert "vertical" in warning
    assert "no heights" in warning
    assert shape_of(apply(found, displaced(truth, 5))) == pytest.approx(shape_of(truth), abs=0.1)


def test_on_a_line_the_cameras_tell_the_vertical():
    positions = np.column_stack([np.linspace(-20, 20, 12), np.full(12, -15.0), np.full(12, 1.6)])
    truth = reconstruction_of(positions)
    noisy = positions + np.random.default_rng(0).normal(0, 0.3, positions.shape)
    found = georeference(displaced(truth, 5), gps_of(noisy))
    assert any("on a line" in text for text in found.warnings)
    assert shape_of(apply(found, displaced(truth, 5))) == pytest.approx(shape_of(truth), abs=1.5)


def test_cameras_closer_together_than_the_noise_are_not_placed():
    positions = around(radius=2.0)
    noisy = positions + np.random.default_rng(0).normal(0, 3, positions.shape)
    found = georeference(displaced(reconstruction_of(positions), 2), gps_of(noisy))
    assert not found.metric
    assert not found.north
    assert found.residual_m is None
    (warning,) = found.warnings
    assert "too close together" in warning


@pytest.mark.parametrize(("lines", "metric"), [(6, False), (60, True)])
def test_rows_that_lie_on_each_other_contradict_gps(lines, metric):
    """Lines of a flight lie on those before; a large flight gives a scale all the same."""
    truth = np.array([[4.0 * x + 0.5, 14.0 * y + 0.5, 20] for y in range(lines) for x in range(10)])
    folded = truth.copy()
    folded[:, 1] = truth[:, 1] % 28 if lines == 6 else truth[:, 1] - truth[:, 1] // 14 % 3 * 14
    found = georeference(displaced(reconstruction_of(folded), 2), gps_of(truth))
    assert found.metric == metric
    assert any("on each other" in warning for warning in found.warnings)


@settings(max_examples=40)
@given(seed=st.integers(0, 10_000))
def test_a_scale_that_is_accepted_is_true_within_its_limit(seed):
    """Whatever the noise: either it is refused, or the scale is right to three times the stated
    limit."""
    rng = np.random.default_rng(seed)
    positions = around(radius=float(rng.uniform(2, 30)), count=int(rng.integers(4, 20)))
    noisy = positions + rng.normal(0, float(rng.uniform(0.1, 5)), positions.shape)
    reconstruction = displaced(reconstruction_of(positions), seed)
    found = georeference(reconstruction, gps_of(noisy))
    if found.metric:
        sizes = np.linalg.norm(shape_of(apply(found, reconstruction)), axis=1) / np.linalg.norm(
            shape_of(reconstruction_of(positions)), axis=1
        )
        assert np.median(sizes) == pytest.approx(1, abs=0.15)


def test_one_position_for_all_photos_is_not_used():
    same = dict.fromkeys(gps_of(around()), PLACE)
    assert not georeference(reconstruction_of(around()), same).metric


def test_three_positions_are_too_few():
    some = dict(list(gps_of(around()).items())[:3])
    found = georeference(reconstruction_of(around()), some)
    (warning,) = found.warnings
    assert "4 are needed" in warning


def test_without_gps_the_scale_is_arbitrary_and_up_is_guessed():
    truth = reconstruction_of(around())
    found = georeference(displaced(truth, 4), {"elsewhere": PLACE})
    assert (found.scale, found.metric, found.north, found.warnings) == (1.0, False, False, ())
    for told in ("scale is arbitrary", "North is not known", "up is guessed"):
        assert told in found.text
    heights = centres(apply(found, displaced(truth, 4)), truth.viewmats)[:, 2]
    true = centres(truth, truth.viewmats)[:, 2]
    assert np.corrcoef(heights, true)[0, 1] == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("tilt_deg", [-30, 0, 60])
def test_up_of_tilted_cameras_before_a_wall(tilt_deg):
    """All look the same way, so that only their own up tells it, but for the tilt."""
    positions = np.column_stack([np.linspace(-5, 5, 8), np.full(8, -10.0), np.full(8, 2.0)])
    truth = reconstruction_of(positions)
    tilt = torch.from_numpy(Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix())
    for viewmat in truth.viewmats.values():
        viewmat[:3] = tilt @ viewmat[:3]
    up = up_of_cameras(truth)
    assert up[0] == pytest.approx(0, abs=0.05)


def test_up_of_cameras_that_look_down():
    viewmats = {}
    for index, heading in enumerate(np.linspace(0, 2 * np.pi, 8, endpoint=False)):
        viewmat = np.eye(4)
        down = Rotation.from_euler("z", heading).as_matrix() @ np.diag([1.0, -1.0, -1.0])
        viewmat[:3, :3] = down
        viewmats[f"view_{index}"] = torch.from_numpy(viewmat)
    truth = reconstruction_of(around(count=8))
    looking_down = Reconstruction(viewmats, truth.lenses, truth.points, None, (), None, "")
    assert up_of_cameras(looking_down) == pytest.approx([0, 0, 1], abs=1e-6)


def wall() -> Reconstruction:
    """Twelve cameras before the wall y = 0, on which points lie 25 cm apart."""
    x, z = np.meshgrid(np.linspace(-4, 4, 33), np.linspace(-3, 3, 25))
    points = np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()])
    positions = np.column_stack([np.linspace(-4, 4, 12), np.full(12, -8.0), np.linspace(-1, 1, 12)])
    return reconstruction_of(positions, points)


def pixel_of(reconstruction: Reconstruction, view: str, point: list[float]) -> tuple[float, float]:
    viewmat = reconstruction.viewmats[view].numpy()
    x, y, z = viewmat[:3, :3] @ point + viewmat[:3, 3]
    u, v = LENS.distort(np.array([x / z]), np.array([y / z]))
    return float(u[0] * LENS.fx + LENS.cx), float(v[0] * LENS.fy + LENS.cy)


@pytest.mark.parametrize("tracks", [True, False])
def test_a_known_distance_sets_the_scale(tracks):
    truth = wall()
    a, b = pixel_of(truth, "view_1", [-1.0, 0, -1.0]), pixel_of(truth, "view_1", [1.0, 0, 0.5])
    found = displaced(truth, 8)
    if not tracks:
        found = Reconstruction(found.viewmats, found.lenses, found.points, None, (), None, "")
    placed = georeference(found, {}, KnownDistance("view_1", a, b, 2.5))
    assert placed.metric
    assert not placed.north
    assert placed.text.startswith("The scale is that of the known distance.")
    assert shape_of(apply(placed, found)).std() == pytest.approx(shape_of(truth).std(), rel=2e-3)


def around_wall() -> Reconstruction:
    """Cameras around the points of a wall."""
    return reconstruction_of(around(), wall().points.positions.double().numpy())


def twice_as_long(truth: Reconstruction) -> KnownDistance:
    """2.5 m between two points of ``around_wall``, said to be 5 m."""
    a, b = pixel_of(truth, "view_9", [-1.0, 0, -1.0]), pixel_of(truth, "view_9", [1.0, 0, 0.5])
    return KnownDistance("view_9", a, b, 5.0)


def test_a_known_distance_decides_against_gps():
    truth = around_wall()
    found = displaced(truth, 8)
    placed = georeference(found, gps_of(around()), twice_as_long(truth))
    assert placed.north
    assert placed.scale_error is None
    assert "known distance" in placed.text
    assert "GPS positions of 12" in placed.text
    (warning,) = placed.warnings
    assert "2 times" in warning
    assert "GPS" in warning
    assert shape_of(apply(placed, found)) == pytest.approx(2 * shape_of(truth), abs=0.2)


def test_given_poses_without_gps_stay():
    found = georeference(reconstruction_of(around()), {}, as_given=True)
    assert (found.scale, found.metric) == (1.0, False)
    assert found.rotation.equal(torch.eye(3, dtype=torch.float64))
    assert "scale is arbitrary" in found.text
    assert "axes are those" in found.text


@pytest.mark.parametrize("seed", range(3))
def test_gps_places_given_poses(seed):
    positions = around()
    truth = reconstruction_of(positions)
    given = displaced(truth, seed)
    found = georeference(given, gps_of(positions), as_given=True)
    assert found.metric
    assert found.north
    assert found.origin is not None
    assert f"{found.residual_m:.2g} m off" in found.text
    assert "turned and scaled" in found.text
    assert shape_of(apply(found, given)) == pytest.approx(shape_of(truth), abs=0.05)


@pytest.mark.parametrize("height", [True, False])
def test_given_poses_that_agree_with_gps_keep_their_scale_and_axes(height):
    """Surveyed poses are surer than GPS: only their origin moves to that of GPS."""
    positions, offset = around(), np.array([300.0, -200.0, 40.0])
    noisy = positions + np.random.default_rng(1).normal(0, 0.5, positions.shape)
    truth = reconstruction_of(positions)
    stay = Georeference(
        1.0, torch.eye(3).double(), torch.from_numpy(offset), False, False, None, None, ""
    )
    given = apply(stay, truth)
    found = georeference(given, gps_of(noisy, height), as_given=True)
    assert (found.scale, found.metric, found.north) == (1.0, True, True)
    assert found.rotation.equal(torch.eye(3, dtype=torch.float64))
    assert "stay as they are" in found.text
    moved = centres(apply(found, given), given.viewmats).mean(axis=0)
    true = enu([gps_of(positions)[name] for name in given.viewmats], found.origin).mean(axis=0)
    assert moved[: 3 if height else 2] == pytest.approx(true[: 3 if height else 2], abs=1.0)


def test_a_known_distance_changes_the_scale_of_given_poses_that_agree_with_gps():
    given = around_wall()
    found = georeference(given, gps_of(around()), twice_as_long(given), as_given=True)
    assert found.scale == pytest.approx(2.0, rel=1e-2)
    assert found.rotation.equal(torch.eye(3, dtype=torch.float64))
    for told in ("known distance", "GPS", "stay as they are"):
        assert told in found.text


def test_given_poses_that_gps_cannot_place_stay():
    given = reconstruction_of(around(0.3))
    noisy = around(0.3) + np.random.default_rng(0).normal(0, 1, (12, 3))
    found = georeference(given, gps_of(noisy), as_given=True)
    assert (found.scale, found.metric, found.north) == (1.0, False, False)
    assert found.rotation.equal(torch.eye(3, dtype=torch.float64))
    assert "GPS positions are not" in found.warnings[0]


@pytest.mark.parametrize("known", [False, True])
def test_given_poses_that_know_their_place_on_earth_stay(known):
    world = WorldFrame(True, True, EarthPosition(48.0, 11.0, 500.0), 0.4, 0.01)
    given = replace(around_wall(), world=world)
    distance = twice_as_long(given) if known else None
    found = georeference(given, gps_of(around()), distance, as_given=True)
    assert found.rotation.equal(torch.eye(3, dtype=torch.float64))
    assert found.world == (replace(world, scale_error=None) if known else world)
    assert ("known distance" if known else "in metres") in found.text
    assert "with north" in found.text
    assert found.scale == (pytest.approx(2.0, rel=1e-2) if known else 1.0)


@pytest.mark.parametrize(
    ("known", "told"),
    [
        (
            KnownDistance("view_1", (100, 100), (200, 100), 0.0),
            ["0 m"],
        ),
        (
            KnownDistance("other", (100, 100), (200, 100), 1.0),
            ["in other", "no pose", "view_0, view_1, view_10, view_11, view_2, …"],
        ),
        (
            KnownDistance("view_1", (100, 100), (401, 100), 1.0),
            ["(401, 100) of view_1", "outside", "400×300 px"],
        ),
        (
            KnownDistance("view_1", (200, 100), (390, 290), 1.0),
            ["(390, 290) of view_1", "points near it"],
        ),
        (
            KnownDistance("view_1", (200, 150), (200, 150), 1.0),
            ["view_1", "two different pixels"],
        ),
    ],
)
def test_a_known_distance_that_cannot_be_used(known, told):
    with pytest.raises(SceneError) as error:
        georeference(wall(), {}, known)
    assert [fact for fact in told if fact not in str(error.value)] == []


def test_a_known_distance_that_ends_at_an_edge():
    """The right half of the wall is moved away along the rays of view_1."""
    flat = wall()
    points, eye = flat.points.positions, torch.from_numpy(centres(flat, ["view_1"])[0]).float()
    points = torch.where(points[:, :1] > 0, eye + 2 * (points - eye), points)
    cloud = PointCloud(points, flat.points.colors)
    stepped = Reconstruction(flat.viewmats, flat.lenses, cloud, flat.visible, (), None, "")
    a, b = pixel_of(flat, "view_1", [-1.0, 0, 0]), pixel_of(flat, "view_1", [0.125, 0, 0])
    with pytest.raises(SceneError, match="near and far"):
        georeference(stepped, {}, KnownDistance("view_1", a, b, 1.0))
