from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mrgs.errors import ConfigError
from mrgs_synth import SceneKind, synthesize

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
    assert celsius.mean() == pytest.approx(exact.mean(), abs=0.1)
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
