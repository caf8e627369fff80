from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrgs.data.cameras import checked_lens
from mrgs.errors import SceneError
from mrgs.scene.lens import WIDEST_ANGLE_DEG, Lens

BOARD = {"radial": (-0.40296695494936713, 0.3692066558782211, 0.0, 0.0)}
THERMOSCENES = {"radial": (0.05, -0.06, 0.0, 0.0), "tangential": (-0.003, 0.062)}
FISHEYE = {"radial": (0.02, -0.01, 0.003, -0.001), "fisheye": True}
BARREL = {"radial": (-0.4, 0.0, 0.0, 0.0)}


def lens(**distortion) -> Lens:
    return Lens(640, 480, 358.5, 627.6, 320.0, 240.0, **distortion)


def test_brown_at_a_point_by_hand():
    x, y = lens(radial=(0.1, 0.01, 0.001, 0.0001), tangential=(0.02, 0.03)).distort(
        np.array([0.6]), np.array([0.8])
    )
    scale = 1 + 0.1 + 0.01 + 0.001 + 0.0001  # r = 1
    assert x == pytest.approx(scale * 0.6 + 2 * 0.02 * 0.48 + 0.03 * (1 + 0.72))
    assert y == pytest.approx(scale * 0.8 + 0.02 * (1 + 1.28) + 2 * 0.03 * 0.48)


def test_fisheye_at_a_point_by_hand():
    x, y = lens(radial=(0.1, 0.01, 0.001, 0.0001), fisheye=True).distort(
        np.array([0.6]), np.array([0.8])
    )
    theta = math.pi / 4
    bent = theta * (1 + 0.1 * theta**2 + 0.01 * theta**4 + 0.001 * theta**6 + 0.0001 * theta**8)
    assert (x, y) == (pytest.approx(0.6 * bent), pytest.approx(0.8 * bent))


@pytest.mark.parametrize("distortion", [BOARD, THERMOSCENES, FISHEYE, BARREL])
@given(angle=st.floats(-math.pi, math.pi), share=st.floats(0, 0.97))
def test_undistort_inverts_distort_inside_the_fold(distortion, angle, share):
    tested = lens(**distortion)
    direction = np.array([math.cos(angle)]), np.array([math.sin(angle)])
    radius = share * tested._fold_radius(*direction)
    ray = direction[0] * radius, direction[1] * radius
    np.testing.assert_allclose(tested.undistort(*tested.distort(*ray)), ray, atol=1e-7)


@pytest.mark.parametrize("distortion", [BOARD, THERMOSCENES, FISHEYE, BARREL])
def test_the_jacobian_is_the_derivative(distortion):
    tested = lens(**distortion)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.6, 0.6, (2, 50))
    step = 1e-6
    by_x = np.subtract(tested.distort(x + step, y), tested.distort(x - step, y)) / (2 * step)
    by_y = np.subtract(tested.distort(x, y + step), tested.distort(x, y - step)) / (2 * step)
    a, b, d = tested._jacobian(x, y)
    np.testing.assert_allclose([by_x[0], by_x[1], by_y[0], by_y[1]], [a, b, b, d], atol=1e-8)


def test_the_fold_of_a_barrel_is_found():
    """r (1 − 0.4 r²) is largest at r = 1 / sqrt(1.2)."""
    fold = 1 / math.sqrt(1.2)
    radius = np.array([0.98 * fold, 1.001 * fold, 2.0])
    assert lens(**BARREL).before_fold(radius, np.zeros(3)).tolist() == [True, False, False]
    ray = lens(**BARREL).undistort(np.array([0.9]), np.array([0.0]))  # no ray reaches so far
    assert 0.95 * fold < ray[0].item() <= fold


def test_the_board_camera_never_folds():
    assert (
        lens(**BOARD)
        .before_fold(np.array([0.9 * math.tan(math.radians(WIDEST_ANGLE_DEG))]), np.zeros(1))
        .all()
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": 0.0}, "must be positive"),
        ({"fy": -1.0}, "must be positive"),
        ({"fx": math.nan}, "NaN"),
        ({"cx": math.inf}, "NaN, infinity"),
        ({"radial": (math.nan, 0.0, 0.0, 0.0)}, "NaN"),
        ({"width": 0}, "not possible"),
        ({"height": 10**9}, "not possible"),
    ],
)
def test_impossible_lenses_are_refused(change, message):
    values = {
        "width": 640,
        "height": 480,
        "fx": 300.0,
        "fy": 300.0,
        "cx": 320.0,
        "cy": 240.0,
        **change,
    }
    with pytest.raises(SceneError, match=f"cameras.txt: .*camera 1.*{message}"):
        checked_lens(Lens(**values), "camera 1", Path("cameras.txt"))
