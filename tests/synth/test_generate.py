from __future__ import annotations

import io
import json
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mrgs.data import load_scene
from mrgs.errors import ConfigError
from mrgs.scene import THERMAL
from mrgs_synth import CameraName, SceneKind, synthesize
from mrgs_synth.colors import from_srgb
from mrgs_synth.planck import band_radiance, temperature
from mrgs_synth.series import BEGUN

SMALL = {"width": 32, "height": 24, "train_views": 2, "eval_views": 1, "samples": 2}


def files(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_scene_from_end_to_end_twice_the_same(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba", reason="the extra synth is not installed")
    calls: list[tuple[int, int]] = []
    synthesize(
        tmp_path / "a", seed=5, progress=lambda done, total: calls.append((done, total)), **SMALL
    )
    synthesize(tmp_path / "b", seed=5, **SMALL)
    written = files(tmp_path / "a")
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert written == files(tmp_path / "b")
    names = ("frame_eval_00001", "frame_train_00001", "frame_train_00002")
    assert sorted(written) == sorted(
        [f"images/{name}.jpg" for name in names]
        + [f"thermal/{name}.png" for name in names]
        + ["sparse_pc.ply", "temperature_bounds.json", "transforms.json", "truth/synth.json"]
        + [f"truth/{kind}/frame_eval_00001.tiff" for kind in ("depth", "temperature")]
    )
    check_thermal_against_truth(tmp_path / "a", "frame_eval_00001")


@pytest.mark.parametrize(("scene", "blur_c"), [("facade", 1.5), ("electronics", 1.0)])
def test_the_other_scenes_from_end_to_end(tmp_path: Path, scene: SceneKind, blur_c: float) -> None:
    pytest.importorskip("mitsuba", reason="the extra synth is not installed")
    synthesize(tmp_path, scene=scene, seed=0, **SMALL)
    assert json.loads((tmp_path / "truth/synth.json").read_text())["scene"] == scene
    check_thermal_against_truth(tmp_path, "frame_eval_00001", blur_c)
    with Image.open(tmp_path / "images/frame_eval_00001.jpg") as image:
        assert 60.0 < np.asarray(image).mean() < 190.0
        assert np.asarray(image).std() > 20.0


def check_thermal_against_truth(scene: Path, name: str, blur_c: float = 0.5) -> None:
    """The thermal image shows the exact temperatures, but for the point spread."""
    bounds = json.loads((scene / "temperature_bounds.json").read_text())
    low, high = bounds["absolute_min_temperature"], bounds["absolute_max_temperature"]
    with Image.open(scene / f"thermal/{name}.png") as image:
        celsius = low + np.asarray(image) / 255.0 * (high - low)
    with Image.open(scene / f"truth/temperature/{name}.tiff") as image:
        exact = np.asarray(image)
    assert low <= exact.min() <= exact.max() <= high
    found, wanted = (temperature(band_radiance(each).mean()) for each in (celsius, exact))
    assert found == pytest.approx(wanted, abs=0.1)
    assert np.median(np.abs(celsius - exact)) < blur_c


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 33}, "33×24"),
        ({"height": 8}, "32×8"),
        ({"train_views": 1}, "training views"),
        ({"eval_views": -1}, "evaluation views"),
        ({"samples": 0}, "samples"),
    ],
)
def test_arguments_that_cannot_be(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        synthesize(tmp_path / "scene", **(SMALL | change))
    assert not (tmp_path / "scene").exists()


@pytest.mark.parametrize("camera", ["phone", "handheld"])
def test_another_camera_changes_the_photos_and_not_the_truth(
    tmp_path: Path, camera: CameraName
) -> None:
    pytest.importorskip("mitsuba", reason="the extra synth is not installed")
    synthesize(tmp_path / "own", seed=5, truth="all", **SMALL)
    synthesize(tmp_path / "other", seed=5, truth="all", camera=camera, **SMALL)
    own, other = files(tmp_path / "own"), files(tmp_path / "other")
    assert set(other) - set(own) == {
        f"truth/camera/{name}" for name in ("camera.json", "shading.tiff", "pattern.tiff")
    }
    exact = [name for name in own if name.startswith(("truth/temperature/", "truth/depth/"))]
    assert len(exact) == 6
    assert all(own[name] == other[name] for name in exact)
    did = json.loads(other["truth/camera/camera.json"])
    scene, truth = load_scene(tmp_path / "other"), tmp_path / "other/truth"
    views = {view.name: view for view in (*scene.train, *scene.eval)}
    assert list(did["photos"]) == ["frame_train_00001", "frame_eval_00001", "frame_train_00002"]
    for name, moment in did["photos"].items():
        thermal = views[name].images[THERMAL]
        record, seen = thermal.record, thermal.load().values.numpy()
        assert record is not None
        assert record.camera == camera
        assert record.taken == BEGUN + timedelta(seconds=round(moment["second"]))
        with Image.open(truth / f"temperature/{name}.tiff") as image:
            off_c = scene.temperature.to_celsius(seen[..., 0]) - np.asarray(image)
        assert np.median(off_c) == pytest.approx(moment["drift_c"], abs=0.5)
        ours, theirs = (folder[f"images/{name}.jpg"] for folder in (other, own))
        gain = brightness(ours) / brightness(theirs)
        assert np.log2(gain) == pytest.approx(moment["exposure_ev"], abs=0.1)


def brightness(jpeg: bytes) -> float:
    """Median linear light."""
    with Image.open(io.BytesIO(jpeg)) as image:
        return float(np.median(from_srgb(np.asarray(image))))


def test_a_camera_that_does_not_suit_the_size_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="34×24"):
        synthesize(tmp_path / "scene", **(SMALL | {"width": 34}), camera="phone")
    assert not (tmp_path / "scene").exists()
