from __future__ import annotations

import numpy as np
import pytest
import torch

from mrgs.errors import SceneError
from mrgs.prepare.rig.adjust import rigid_motion
from mrgs.prepare.rig.chessboard import Corners
from mrgs.prepare.rig.target import Sighting, localise
from mrgs.scene import Camera
from tests.helpers.rig_room import make_board

K = torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]], dtype=torch.float64)
STILL = (0.3, -0.4, 0.2, -0.25, -0.2, 1.5)
NOISE_PX = 0.05


def camera(view: int, apart: float = 0.15) -> Camera:
    rng = np.random.default_rng(view)
    motion = np.concatenate([rng.normal(0, 0.1, 3), rng.normal(0, apart, 3)])
    return Camera(K, rigid_motion(torch.from_numpy(motion)), 320, 240)


def sighting(view: int, board, camera: Camera, quarters: int = 0) -> tuple[Sighting, np.ndarray]:
    """What the camera sees of a board, with noise, and the corners in its axes, both in the order
    of the sighting."""
    rows, columns = board.inner[::-1]
    inside = board.corners @ camera.viewmat[:3, :3].numpy().T + camera.viewmat[:3, 3].numpy()
    pixels = inside[:, :2] / inside[:, 2:] * 300 + (160, 120)
    pixels = pixels + np.random.default_rng(view).normal(0, NOISE_PX, pixels.shape)
    grid, truth = (np.rot90(a.reshape(rows, columns, -1), quarters) for a in (pixels, inside))
    return Sighting(f"view_{view}", camera, Corners(grid), None), truth.reshape(-1, 3)


def nearest(points: np.ndarray, truth: np.ndarray) -> float:
    """The largest distance of a point from the true corners, whatever their order."""
    return float(max(np.linalg.norm(truth - point, axis=1).min() for point in points))


@pytest.mark.parametrize("inner", [(6, 5), (4, 4)])
def test_a_target_that_stands_still_is_placed_and_tells_its_size(inner):
    board = make_board(STILL, inner=inner, square_m=0.12)
    step = 1 if inner[0] == inner[1] else 2
    made = [sighting(view, board, camera(view), quarters=step * view % 4) for view in range(5)]
    found = localise([each for each, _ in made])
    assert found.stationary == 5
    assert found.square == pytest.approx(0.12, rel=0.01)
    for points, (_, truth) in zip(found.points, made, strict=True):
        assert nearest(points, truth) < 0.01
    worlds = [
        (points - s.camera.viewmat[:3, 3].numpy()) @ s.camera.viewmat[:3, :3].numpy()
        for s, points in zip(found.sightings, found.points, strict=True)
    ]
    assert np.ptp(worlds, axis=0).max() < 0.01


def test_a_target_that_is_moved_is_placed_by_the_width_of_its_squares():
    boards = [
        make_board((0.3, 0.2 * view, 0.1, -0.2, -0.2 + 0.05 * view, 1.0 + 0.1 * view))
        for view in range(4)
    ]
    made = [sighting(view, board, camera(view)) for view, board in enumerate(boards)]
    found = localise([each for each, _ in made], 0.1)
    assert found.stationary == 0
    for points, (_, truth) in zip(found.points, made, strict=True):
        assert np.linalg.norm(points - truth, axis=1).max() < 0.01


def test_one_that_is_moved_among_those_that_stand_still():
    boards = [make_board(STILL)] * 4 + [make_board((0.0, 0.1, 0.0, 0.1, -0.2, 1.3))]
    made = [sighting(view, board, camera(view)) for view, board in enumerate(boards)]
    found = localise([each for each, _ in made])
    assert found.stationary == 4
    assert np.linalg.norm(found.points[4] - made[4][1], axis=1).max() < 0.015


def test_a_moved_target_of_unknown_size_and_one_seen_from_one_place_are_told():
    boards = [make_board((0.3, 0.2 * view, 0.1, -0.2, -0.2, 1.0 + 0.1 * view)) for view in range(4)]
    moved = [sighting(view, board, camera(view))[0] for view, board in enumerate(boards)]
    same_place = [
        sighting(view, make_board(STILL), camera(view, apart=1e-4))[0] for view in range(4)
    ]
    for sightings in (moved, same_place, moved[:1]):
        with pytest.raises(SceneError, match=r"target .* distance"):
            localise(sightings)
