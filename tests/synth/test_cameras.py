from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from mrgs_synth.cameras import CameraArc, look_at, pinhole

coordinate = st.floats(-5.0, 5.0)
point = st.tuples(coordinate, coordinate, coordinate).map(np.array)


@given(point, point)
def test_look_at(position: np.ndarray, target: np.ndarray) -> None:
    assume(np.linalg.norm((target - position)[:2]) > 0.01)
    viewmat = look_at(position, target)
    rotation = viewmat[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(rotation @ position + viewmat[:3, 3], 0.0, atol=1e-9)
    distance = np.linalg.norm(target - position)
    np.testing.assert_allclose(rotation @ target + viewmat[:3, 3], [0.0, 0.0, distance], atol=1e-9)
    assert rotation[0, 2] == pytest.approx(0.0, abs=1e-9)  # the horizon is level
    assert rotation[1, 2] < 0.0  # y points down


def test_pinhole_has_the_field_of_view() -> None:
    K = pinhole(55.0, 320, 240)
    assert 2 * np.degrees(np.arctan(160 / K[0, 0].item())) == pytest.approx(55.0)
    assert K[0, 0] == K[1, 1]
    assert K[:2, 2].tolist() == [160.0, 120.0]


STILL = CameraArc(
    (0.1, 0.2, 0.3), (-100.0, 80.0), ((20.0, 1.0), (40.0, 1.2), (60.0, 0.9)), jitter_m=0.0
)


def azimuth_deg(camera, target: tuple[float, float, float]) -> float:
    offset = camera.position.numpy() - np.array(target)
    return float(np.degrees(np.arctan2(offset[1], offset[0])))


def test_train_cameras_are_even_and_alternate_in_height() -> None:
    cameras = STILL.train(9, 32, 24, np.random.default_rng(0))
    angles = [azimuth_deg(camera, STILL.target) for camera in cameras]
    np.testing.assert_allclose(angles, np.arange(-90.0, 90.0, 20.0))
    distances = [np.linalg.norm(camera.position.numpy() - STILL.target) for camera in cameras]
    np.testing.assert_allclose(distances, [1.0, 1.2, 0.9] * 3)


@pytest.mark.parametrize(("train_count", "count"), [(40, 8), (9, 4), (2, 1), (5, 4)])
def test_eval_cameras_lie_between_neighbours(train_count: int, count: int) -> None:
    rng = np.random.default_rng(0)
    train = [azimuth_deg(camera, STILL.target) for camera in STILL.train(train_count, 32, 24, rng)]
    held_out = [
        azimuth_deg(camera, STILL.target)
        for camera in STILL.between(count, train_count, 32, 24, rng)
    ]
    spacing = 180.0 / train_count
    for angle in held_out:
        nearest = np.sort(np.abs(np.array(train) - angle))
        assert nearest[:2] == pytest.approx([spacing / 2, spacing / 2])
    assert len(set(np.round(held_out, 6))) == count


def test_jitter_is_seeded() -> None:
    arc = CameraArc((0.0, 0.0, 0.0), (0.0, 90.0), ((30.0, 1.0),), jitter_m=0.05)
    one, same, other = (arc.train(3, 32, 24, np.random.default_rng(seed))[0] for seed in (1, 1, 2))
    assert one.viewmat.equal(same.viewmat)
    assert not one.viewmat.equal(other.viewmat)
