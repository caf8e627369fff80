"""A model that a lens has bent is straightened by control points."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import msgspec
import numpy as np
import pytest

from mrgs.prepare.contract import rms_m
from mrgs.prepare.control import ControlPoint, ControlPoints, place_by_control
from mrgs.prepare.sfm.job import (
    ADJUSTED_FOLDER,
    CONTROL_FILE,
    JOB_FILE,
    MODEL_FOLDER,
    REPORT_FILE,
    ImageReport,
    JobFile,
    JobImage,
    ModelReport,
    read_job,
)
from mrgs.prepare.sfm.reconstruct import adjusted, read_result
from mrgs.scene import RGB
from mrgs.scene.lens import Lens

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed (extra sfm)"
)

TRUE = Lens(800, 600, 640.0, 640.0, 407.0, 293.0, (-0.12, 0.05, 0.0, 0.0), (5e-4, -5e-4))
FITTED = [632.0, 400.0, 300.0, -0.09]
"""What structure from motion makes of it: focal length, centre, k1."""

COUNT = 14
EYES = [np.array([2.0 * i, -9.0 + 0.3 * (i % 3), 2.0 + 1.5 * (i % 2)]) for i in range(COUNT)]


def pose(index: int) -> np.ndarray:
    """World to camera of a camera that looks north, a little to the side."""
    forward = np.array([(0.15, -0.1, 0.0)[index % 3], 1.0, 0.05])
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0, 1])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([turn, -turn @ EYES[index]])


def pixels(points: np.ndarray, viewmat: np.ndarray) -> np.ndarray:
    x, y, z = viewmat[:, :3] @ points.T + viewmat[:, 3:]
    u, v = TRUE.distort(x / z, y / z)
    return np.column_stack([u, v]) * TRUE.fx + [TRUE.cx, TRUE.cy]


def inside(found: np.ndarray) -> np.ndarray:
    return ((found > 5) & (found < [795, 595])).all(axis=1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A finished job: a model whose poses and points were adjusted to the wrong lens."""
    import pycolmap

    rng = np.random.default_rng(0)
    points = rng.uniform([-3, -1, 0], [2.0 * COUNT + 1, 0.5, 6], (900, 3))
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=800, height=600, params=FITTED, camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in points]
    for index in range(COUNT):
        seen = pixels(points, pose(index)) + rng.normal(0, 0.3, (len(points), 2))
        rows = np.flatnonzero(inside(seen))
        image = pycolmap.Image(f"{index:06d}.jpg", image_id=index + 1, camera_id=1)
        unused = [pycolmap.Point2D(np.array([1.0, 1.0])) for _ in range(400)]
        image.points2D = [*(pycolmap.Point2D(seen[row]) for row in rows), *unused]
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose(index)))
        for place, row in enumerate(rows):
            tracks[row].add_element(index + 1, place)
    for point, track in zip(points, tracks, strict=True):
        if track.length() > 2:
            model.add_point3D(point, track)
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    names = [f"{index:06d}.jpg" for index in range(COUNT)]
    images = tuple(JobImage(name, f"v{index}") for index, name in enumerate(names))
    (tmp_path / JOB_FILE).write_bytes(msgspec.json.encode(JobFile(images)))
    from mrgs.prepare.sfm import mapping

    reports = tuple(ImageReport(900, 100, None, 0) for _ in names)
    mapping._write(
        read_job(tmp_path), MODEL_FOLDER, [model], ModelReport(reports, (COUNT,), 0.4, False)
    )
    return tmp_path


def marked(place: tuple[float, float, float], check: bool) -> ControlPoint:
    marks = {}
    for index in range(COUNT):
        (pixel,) = pixels(np.array([place]), pose(index))
        ahead = pose(index)[2] @ [*place, 1]
        if ahead > 0 and inside(pixel[None])[0]:
            marks[f"v{index}"] = tuple(pixel.tolist())
    return ControlPoint(marks, place, check)


CORNERS = [(0.0, 0.0, 0.8), (26.0, 0.2, 1.0), (0.5, 0.0, 5.5), (25.5, 0.0, 5.0)]
CHECKS = [(x, -0.3, z) for x in (6.0, 13.0, 20.0) for z in (1.0, 5.0)]


def test_control_points_straighten_what_the_lens_has_bent(folder, monkeypatch):
    from mrgs.prepare.sfm.mapping import adjust

    points = {f"C{n}": marked(place, False) for n, place in enumerate(CORNERS)}
    points |= {f"K{n}": marked(place, True) for n, place in enumerate(CHECKS)}
    control, found = ControlPoints(points), read_result(folder, RGB)
    steps = []
    monkeypatch.setattr(
        "mrgs.prepare.sfm.reconstruct.run_colmap",
        lambda where, progress: adjust(read_job(where), lambda *step: steps.append(step)),
    )

    def straightened(similarity, places):
        return adjusted(folder, RGB, lambda *step: None, similarity, places)

    _, before = place_by_control(found, control, {})
    after, placed = place_by_control(found, control, {}, straightened)
    bent_m, straight_m = (rms_m(each.control, "check") for each in (before, placed))
    assert bent_m > 0.04
    assert straight_m < 0.015
    assert steps == [("adjusting", 0, 0)]
    assert placed.scale == 1.0
    lens = after.lenses["v0"]
    assert (lens.fx, lens.cx, lens.cy) == pytest.approx((TRUE.fx, TRUE.cx, TRUE.cy), abs=3)
    assert len(after.points.positions) == len(found.points.positions)
    assert after.reprojection_px < found.reprojection_px + 0.2
    assert not (folder / CONTROL_FILE).exists()
    assert (folder / MODEL_FOLDER / REPORT_FILE).is_file()
    assert (folder / ADJUSTED_FOLDER / REPORT_FILE).is_file()


def test_without_control_points_nothing_is_adjusted(folder):
    from mrgs.prepare.sfm.mapping import adjust

    adjust(read_job(folder), pytest.fail)
    assert not (folder / ADJUSTED_FOLDER).exists()
