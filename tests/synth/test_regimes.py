"""Harder versions of a scene, read back by the loader."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import torch

from mrgs.data import load_scene
from mrgs.data.transforms import TRANSFORMS
from mrgs.errors import ConfigError
from mrgs.scene import RGB, THERMAL, Scene
from mrgs.scene.radiometry import PhotoRecord
from mrgs_synth.regimes import ALSO_HELD_OUT, DRIFT_C, REGIMES, main, make_regime

SCENE = Path(__file__).parents[2] / "examples" / "tabletop"


@pytest.fixture(scope="module")
def original() -> Scene:
    return load_scene(SCENE)


def made(folder: Path, name: str, seed: int = 0) -> Scene:
    make_regime(SCENE, folder, name, seed)
    return load_scene(folder)


def pixels(scene: Scene, split: str, number: int) -> np.ndarray:
    return getattr(scene, split)[number].images[THERMAL].load().values.numpy()


@pytest.mark.parametrize("name", sorted(REGIMES.keys() - ALSO_HELD_OUT))
def test_the_evaluation_and_its_truth_stay(tmp_path: Path, original: Scene, name: str) -> None:
    scene = made(tmp_path / "out", name)
    assert [view.name for view in scene.eval] == [view.name for view in original.eval]
    for ours, theirs in zip(scene.eval, original.eval, strict=True):
        for modality in (RGB, THERMAL):
            one, two = ours.images[modality].camera, theirs.images[modality].camera
            torch.testing.assert_close(one.viewmat, two.viewmat)
            torch.testing.assert_close(one.K, two.K)
    np.testing.assert_array_equal(pixels(scene, "eval", 0), pixels(original, "eval", 0))
    assert scene.temperature == original.temperature
    assert len(scene.points.positions) == len(original.points.positions)
    truth = {path.relative_to(SCENE) for path in (SCENE / "truth").rglob("*.tiff")}
    assert truth == {p.relative_to(tmp_path / "out") for p in tmp_path.rglob("truth/*/*.tiff")}


def test_all_is_the_scene_itself(tmp_path: Path, original: Scene) -> None:
    scene = made(tmp_path / "out", "all")
    assert [view.name for view in scene.train] == [view.name for view in original.train]
    name = original.train[0].name
    image = next((tmp_path / "out" / "images").glob(f"{name}.*"))
    assert image.read_bytes() == (SCENE / "images" / image.name).read_bytes()
    for ours, theirs in zip(scene.train, original.train, strict=True):
        assert ours.images[THERMAL].camera.coincides_with(ours.images[RGB].camera)
        torch.testing.assert_close(
            ours.images[RGB].camera.viewmat, theirs.images[RGB].camera.viewmat
        )


@pytest.mark.parametrize("count", [8, 12])
def test_fewer_views_are_spread_evenly(tmp_path: Path, original: Scene, count: int) -> None:
    scene = made(tmp_path / "out", f"views-{count}")
    names = [view.name for view in original.train]
    chosen = [names.index(view.name) for view in scene.train]
    assert len(chosen) == count
    assert (chosen[0], chosen[-1]) == (0, len(names) - 1)
    assert np.ptp(np.diff(chosen)) <= 1


@pytest.mark.parametrize(
    ("name", "side", "shift"),
    [
        ("poses-2px", "train", 2.0),
        ("poses-4px", "train", 4.0),
        ("every-pose-2px", "train", 2.0),
        ("every-pose-2px", "eval", 2.0),
    ],
)
def test_pose_errors_shift_the_points_by_pixels(
    tmp_path: Path, original: Scene, name: str, side: str, shift: float
) -> None:
    scene = made(tmp_path / "out", name)
    points = original.points.positions.double()
    shifts = []
    for ours, theirs in zip(getattr(scene, side), getattr(original, side), strict=True):
        wrong, right = ours.images[RGB].camera, theirs.images[RGB].camera
        assert wrong.coincides_with(ours.images[THERMAL].camera)
        (a, _), (b, _) = (torch_project(camera, points) for camera in (wrong, right))
        inside = right.contains(b)
        shifts.append(float((a - b)[inside].norm(dim=-1).mean()))
    assert np.mean(shifts) == pytest.approx(shift, rel=0.15)
    assert np.std(shifts) > 0.1 * shift


def torch_project(camera, points):  # type: ignore[no-untyped-def]
    at = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixel = at @ camera.K.T
    return pixel[:, :2] / pixel[:, 2:], at[:, 2]


def test_noise_is_thirty_decibels_below_the_range(tmp_path: Path, original: Scene) -> None:
    scene = made(tmp_path / "out", "noise")
    for number in (0, 20):
        difference = pixels(scene, "train", number) - pixels(original, "train", number)
        assert -20.0 * np.log10(difference.std()) == pytest.approx(30.0, abs=0.5)
    assert (pixels(scene, "train", 0) != pixels(made(tmp_path / "b", "noise", 1), "train", 0)).any()
    again = made(tmp_path / "c", "noise")
    np.testing.assert_array_equal(pixels(scene, "train", 0), pixels(again, "train", 0))


def test_a_drift_shifts_whole_photos(tmp_path: Path, original: Scene) -> None:
    scene = made(tmp_path / "out", "drift")
    assert scene.temperature == original.temperature
    shifts = []
    for number in range(0, len(scene.train), 4):
        difference = pixels(scene, "train", number) - pixels(original, "train", number)
        celsius = difference * original.temperature.span_c
        assert np.ptp(celsius) < 1e-3
        shifts.append(celsius.mean())
    assert np.abs(shifts).max() <= DRIFT_C + 1e-3
    assert np.std(shifts) > 0.3 * DRIFT_C


def test_a_strong_drift_is_of_degrees_and_keeps_the_temperatures_apart(
    tmp_path: Path, original: Scene
) -> None:
    scene = made(tmp_path / "out", "drift-5c")
    span_c = original.temperature.span_c
    shifts = [
        span_c * (pixels(scene, "train", n) - pixels(original, "train", n)) for n in range(0, 40, 4)
    ]
    assert max(np.ptp(shift) for shift in shifts) < 1e-3
    assert 2.0 < np.ptp([shift.mean() for shift in shifts]) < 6.0


def test_what_the_camera_noted_of_a_photo_is_kept(tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    make_regime(SCENE, scene, "all", 0)
    content = json.loads((scene / TRANSFORMS).read_text())
    record = PhotoRecord(camera="phone", taken=datetime(2026, 1, 15, 9, 30))
    for frame in content["frames"]:
        frame["thermal_record"] = record.to_json()
    (scene / TRANSFORMS).write_text(json.dumps(content))
    make_regime(scene, tmp_path / "out", "views-8", 0)
    views = load_scene(tmp_path / "out").train
    assert [view.images[THERMAL].record for view in views] == 8 * [record]


@pytest.mark.parametrize(("name", "left"), [("missing-half", 20), ("missing-90", 4)])
def test_thermal_photos_are_missing(tmp_path: Path, original: Scene, name: str, left: int) -> None:
    scene = made(tmp_path / "out", name)
    assert len(scene.train) == len(original.train) == 40
    assert sum(THERMAL in view.images for view in scene.train) == left
    assert all(RGB in view.images for view in scene.train)
    other = made(tmp_path / "other", name, seed=1)
    assert [THERMAL in v.images for v in scene.train] != [THERMAL in v.images for v in other.train]


def test_small_thermal_photos_show_the_same(tmp_path: Path, original: Scene) -> None:
    scene = made(tmp_path / "out", "thermal-quarter")
    small, large = (s.train[3].images[THERMAL] for s in (scene, original))
    assert (small.camera.width, small.camera.height) == (80, 60)
    torch.testing.assert_close(small.camera.K, large.camera.resized(80, 60).K)
    blocks = large.load().values.numpy()[..., 0].reshape(60, 4, 80, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(small.load().values.numpy()[..., 0], blocks, atol=0.51 / 255)
    assert scene.train[3].images[RGB].camera.width == 320


def test_what_cannot_be(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"fog: .*all, views-12"):
        make_regime(SCENE, tmp_path / "out", "fog")
    with pytest.raises(ConfigError, match=r"no transforms\.json"):
        make_regime(tmp_path, tmp_path / "out", "all")
    main([str(SCENE), str(tmp_path / "out"), "--name", "views-8"])
    with pytest.raises(ConfigError, match="already"):
        make_regime(SCENE, tmp_path / "out", "all")
    with pytest.raises(ConfigError, match=r"8 .*than 12"):
        make_regime(tmp_path / "out", tmp_path / "fewer", "views-12")
