"""The thermal camera found with a chessboard, in the room of the other tests."""

from __future__ import annotations

from dataclasses import replace

import pytest

from mrgs.errors import ConfigError, SceneError
from mrgs.prepare.rig.calibrate import calibrate_rig
from mrgs.prepare.rig.contract import ChessboardTarget, RigOptions
from tests.helpers.rig_room import build_room, make_board

STILL = (0.15, 0.25, 0.1, -0.475, -0.42, 2.6)
TARGET = ChessboardTarget((6, 5), 0.16)
SQUARE_UNITS = 0.16
"""The room's unit is a metre."""


@pytest.fixture(scope="module")
def still_room():
    board = make_board(STILL, square_m=SQUARE_UNITS)
    return build_room(views=4, motion_rad=0.01, boards=[board, board, board, None])


def test_a_target_that_stands_still(still_room):
    stages = []
    found = calibrate_rig(
        still_room.pairs,
        still_room.points,
        RigOptions(target=TARGET),
        lambda stage, done, total: stages.append(stage),
    )
    errors_px = still_room.errors_px(found)
    assert max(errors_px[:3]) < 0.3
    assert errors_px[3] < 0.8
    assert found.target is not None
    assert found.target.pairs == 3
    assert found.target.residual_px[0] < 0.1
    assert found.target.metres_per_unit == pytest.approx(1.0, rel=0.01)
    assert len(set(stages)) == 3
    assert "target" in stages[0]
    assert stages[-1] == "matching"


@pytest.mark.slow
def test_a_target_that_is_moved():
    boards = [
        make_board(
            (0.15, 0.2 * view - 0.2, 0.1, -0.475, -0.42, 2.4 + 0.1 * view), square_m=SQUARE_UNITS
        )
        for view in range(3)
    ]
    room = build_room(views=3, boards=boards)
    with pytest.raises(SceneError, match="target cannot"):
        calibrate_rig(room.pairs, room.points, RigOptions(target=TARGET))
    found = calibrate_rig(room.pairs, room.points, RigOptions(target=TARGET, metres_per_unit=1.0))
    assert max(room.errors_px(found)) < 0.3
    assert found.target.metres_per_unit is None


def test_a_target_that_is_not_there_is_told(still_room):
    with pytest.raises(SceneError, match=r"5×4 .* 0 photos"):
        calibrate_rig(
            still_room.pairs[:1], still_room.points, RigOptions(target=ChessboardTarget((5, 4)))
        )
    blank = replace(still_room.pairs[0], load_thermal=still_room.pairs[3].load_thermal)
    with pytest.raises(SceneError, match=r"1 photos .* 0 thermal images"):
        calibrate_rig([blank], still_room.points, RigOptions(target=TARGET))


@pytest.mark.parametrize("inner", [(2, 5), (6, 51)])
def test_counts_that_no_target_has(inner):
    with pytest.raises(ConfigError, match=f"{inner[0]}×{inner[1]} inner corners"):
        ChessboardTarget(inner)


@pytest.mark.parametrize("square_m", [0.0, -0.1, float("nan"), float("inf")])
def test_squares_that_no_target_has(square_m):
    with pytest.raises(ConfigError, match="squares"):
        ChessboardTarget((6, 5), square_m)
