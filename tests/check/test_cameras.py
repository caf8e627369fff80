"""Every problem of cameras and points is found where it was made, and not in the bundled scene."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
import torch

from mrgs.check.cameras import too_near
from mrgs.check.problem import NO_POINTS
from mrgs.data import load_scene
from mrgs.scene import THERMAL, Camera, PointCloud, View
from tests.check.conftest import pose_problems
from tests.helpers.changed_views import with_cameras, with_image
from tests.helpers.views import small_camera

FLIP = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))


def moved(camera: Camera, matrix: torch.Tensor) -> Camera:
    return replace(camera, viewmat=matrix)


def at(camera: Camera, position: torch.Tensor) -> Camera:
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    return moved(camera, viewmat)


def zoomed(camera: Camera, change) -> Camera:
    K = camera.K.clone()
    change(K)
    return replace(camera, K=K)


def test_the_bundled_scene_has_no_problems(tabletop):
    assert tabletop.problems() == []


@pytest.mark.parametrize(
    ("read", "words", "remedy"),
    [
        (
            lambda viewmat: FLIP @ viewmat,
            "axes as in OpenCV",
            "Negate",
        ),
        (
            lambda viewmat: FLIP @ torch.linalg.inv(viewmat),
            "with OpenCV axes",
            "then negate",
        ),
        (
            lambda viewmat: FLIP @ torch.linalg.inv(FLIP @ viewmat),
            "with OpenGL axes",
            "camera to world",
        ),
    ],
)
def test_a_mixed_up_convention_is_named(tabletop, read, words, remedy):
    """``read`` gives the view matrix that the reader makes of a file which holds ``words``, from
    the right one."""
    broken = tabletop.posed(
        lambda view: with_cameras(view, lambda camera: moved(camera, read(camera.viewmat)))
    )
    problem = pose_problems(broken.scene)[0]
    assert problem.severity == "error"
    assert words in problem.text
    assert remedy in problem.remedy


def test_points_of_another_world_are_told(tabletop):
    points = tabletop.scene.points
    far = replace(tabletop.scene, points=PointCloud(points.positions + 1000, points.colors))
    (problem,) = pose_problems(far)
    assert problem.severity == "error"
    assert "one world" in problem.remedy


def test_a_camera_that_looks_away_is_named(tabletop):
    turned = tabletop.posed(
        lambda view: with_cameras(view, lambda c: moved(c, FLIP @ c.viewmat)), every=100, first=5
    )
    (problem,) = pose_problems(turned.scene)
    assert f"({tabletop.scene.train[5].name})" in problem.text
    assert "looks away" in problem.text


def test_points_outside_all_views_are_told(tabletop):
    points = tabletop.scene.points
    positions = points.positions.clone()
    positions[::3, 2] += 50
    (problem,) = pose_problems(replace(tabletop.scene, points=PointCloud(positions, points.colors)))
    assert "33% of the points" in problem.text


def scaled(tabletop, factor: float):
    points = PointCloud(tabletop.scene.points.positions * factor, tabletop.scene.points.colors)
    posed = tabletop.posed(lambda view: with_cameras(view, lambda c: at(c, c.position * factor)))
    return replace(posed.scene, points=points)


def test_a_scale_that_is_wildly_off_is_told(tabletop):
    (problem,) = pose_problems(scaled(tabletop, 1e6))
    assert problem.severity == "error"
    assert "scale" in problem.text


@pytest.mark.parametrize(
    ("factor", "share", "remedy"), [(1e-3, 100, 1_000), (1e-5, 100, 100_000), (0.0125, 9, 100)]
)
def test_a_scene_before_the_near_plane_is_told(factor, share, remedy, tabletop):
    (problem,) = pose_problems(scaled(tabletop, factor))
    assert problem.severity == "error"
    assert problem.text.startswith(f"{share}% ")
    assert "nearer than 0.01 units" in problem.text
    assert f"by {remedy:,}." in problem.remedy


@pytest.mark.parametrize("factor", [1e5, 1e3, 0.02, 0.015])
def test_units_that_suit_are_no_problem(factor, tabletop):
    assert pose_problems(scaled(tabletop, factor)) == []


def test_a_scene_in_map_coordinates_is_told(tabletop):
    offset = torch.tensor([690_000.0, 5_330_000.0, 0], dtype=torch.float64)
    far = tabletop.posed(lambda view: with_cameras(view, lambda c: at(c, c.position + offset)))
    points = PointCloud(
        tabletop.scene.points.positions + offset.float(), tabletop.scene.points.colors
    )
    texts = [problem.text for problem in pose_problems(replace(far.scene, points=points))]
    assert any("from the origin" in text for text in texts)


def test_views_of_one_pose_are_told_and_more_so_if_one_is_held_out(tabletop):
    scene = tabletop.scene
    again = replace(scene.train[3], name="again")
    (problem,) = pose_problems(replace(scene, train=(*scene.train, again)))
    assert f"another view ({scene.train[3].name}, again)" in problem.text
    assert "held out" not in problem.text
    (problem,) = pose_problems(replace(scene, eval=(*scene.eval, again)))
    assert "In 1 of them" in problem.text
    assert "held out" in problem.text


def test_views_of_one_pose_that_show_different_modalities_are_not_told(tabletop):
    scene = tabletop.scene
    apart = [
        [View(f"{view.name}_{name}", {name: image}) for name, image in view.images.items()]
        for view in scene.train
    ]
    assert pose_problems(replace(scene, train=tuple(itertools.chain(*apart)))) == []


def test_a_thermal_camera_that_looks_elsewhere_is_told(tabletop):
    def turn(view: View) -> View:
        return with_image(
            view,
            THERMAL,
            lambda image: replace(image, camera=moved(image.camera, FLIP @ image.camera.viewmat)),
        )

    (problem,) = pose_problems(tabletop.posed(turn, every=10).scene)
    assert problem.severity == "error"
    assert "3 views" in problem.text
    assert "thermal_transform_matrix" in problem.remedy


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda K: K[0].mul_(20), "field of view"),
        (lambda K: K[0, :1].mul_(0.1), "field of view"),
        (lambda K: K[0, 2:].mul_(1.7), "85% of the width"),
        (lambda K: K[1, 1:2].mul_(3), "0.33 times"),
    ],
)
def test_intrinsics_that_no_camera_has_are_told(tabletop, change, words):
    odd = tabletop.posed(
        lambda view: with_cameras(view, lambda camera: zoomed(camera, change)), every=12
    )
    texts = [problem.text for problem in pose_problems(odd.scene)]
    for kind in ("RGB", "thermal"):
        assert any(f"{kind} intrinsics of 3" in text and words in text for text in texts), texts


@pytest.mark.parametrize(("count", "severity"), [(2, "error"), (8, "warning")])
def test_few_views_are_told(tabletop, count, severity):
    problem = pose_problems(replace(tabletop.scene, train=tabletop.scene.train[:count]))[0]
    assert problem.severity == severity
    assert f"{count} training views" in problem.text


def test_a_scene_without_held_out_views_is_told(tabletop):
    (problem,) = pose_problems(replace(tabletop.scene, eval=()))
    assert "held out" in problem.text


def test_a_scene_without_points_is_told(make_scene):
    folder = make_scene()
    (folder / "sparse_pc.ply").unlink()
    scene = load_scene(folder)
    assert any(note.startswith(NO_POINTS) for note in scene.notes)
    assert any("sparse_pc.ply" in problem.remedy for problem in pose_problems(scene))


def wall(depth: float, count: int = 1000) -> torch.Tensor:
    """Points of a wall before ``small_camera``, all in its image."""
    across = torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) - 0.5
    return torch.cat([across * 0.5 * depth, torch.full((count, 1), depth)], dim=1)


@pytest.mark.parametrize(("depth", "factor"), [(0.0099, 1_000), (1e-3, 1_000), (9e-9, 10**9)])
def test_a_wall_before_the_near_plane_is_too_near(depth, factor):
    assert too_near([small_camera()], wall(depth)) == (1.0, factor)


@pytest.mark.parametrize("depth", [0.0101, 1.0, 1e6])
def test_a_wall_behind_it_is_not(depth):
    assert too_near([small_camera()], wall(depth)) is None


def test_only_what_the_cameras_see_counts():
    beside = wall(1e-3) + torch.tensor([1.0, 0, 0])
    behind = wall(-1e-3)
    assert too_near([small_camera()], torch.cat([wall(0.02), beside, behind])) is None
    assert too_near([small_camera()], behind) is None
    assert too_near([small_camera()], torch.empty(0, 3)) is None


def test_strays_do_not_count():
    assert too_near([small_camera()], torch.cat([wall(1e-3, 200), wall(2.0)])) is None
    assert too_near([small_camera()], torch.cat([wall(1e-3, 5), wall(0.5)])) is None
    found = too_near([small_camera(), small_camera()], torch.cat([wall(1e-3, 200), wall(0.5, 800)]))
    assert found is not None
    assert found == (pytest.approx(0.2), 10)
