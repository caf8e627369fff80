from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from mrgs.errors import ConfigError
from mrgs.synth.hits import Triangles, first_hits
from mrgs.synth.stage import Stage
from mrgs.synth.tracer import PathTracer, load_mitsuba, to_srgb


def test_srgb_curve() -> None:
    assert to_srgb(np.array([-1.0, 0.0, 0.002, 0.2140, 1.0, 7.0])).tolist() == [0, 0, 7, 127, 255, 255]


def test_missing_mitsuba_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(ConfigError, match=r'pip install "mrgs\[synth\]"'):
        load_mitsuba()


def test_photos_and_first_hits_see_the_same_outlines(tmp_path: Path, two_boxes: Stage) -> None:
    pytest.importorskip("mitsuba", reason="the extra synth is not installed")
    tracer = PathTracer(two_boxes, tmp_path)
    camera = two_boxes.cameras.train(3, 64, 48, np.random.default_rng(0))[2]
    photo = tracer.photograph(camera, samples=8, seed=0).astype(int)
    is_red = photo[..., 0] > 2 * photo[..., 1]
    is_box = first_hits(camera, Triangles.of(two_boxes.solids)).solid == 1
    assert 0.02 < is_box.mean() < 0.5
    assert (is_red != is_box).mean() < 0.2 * is_box.mean()  # pixels on the outline alone
    assert photo.max(axis=-1).min() > 20  # no black areas


def test_texture_stands_upright(tmp_path: Path, two_boxes: Stage) -> None:
    pytest.importorskip("mitsuba", reason="the extra synth is not installed")
    import dataclasses

    from mrgs.synth.shapes import box

    texture = np.full((8, 8, 3), 30, dtype=np.uint8)
    texture[:4, :, 0] = texture[:, :4, 2] = 250  # red in the upper half, blue in the left half
    wall = dataclasses.replace(
        two_boxes.solids[1],
        mesh=box(0.6, 0.2, 0.4),
        material=dataclasses.replace(two_boxes.solids[1].material, texture=texture),
        position=(0.0, 0.0, 0.0),
        yaw_deg=90.0,  # the front of the box faces the camera, which stands on the x axis
    )
    stage = dataclasses.replace(two_boxes, solids=(wall,), lamps=())
    camera = dataclasses.replace(
        stage.cameras, rings=((5.0, 1.0),), azimuth_deg=(0.0, 0.0), jitter_m=0.0, target=(0.0, 0.0, 0.2)
    )
    photo = (
        PathTracer(stage, tmp_path).photograph(camera.train(1, 64, 48, np.random.default_rng(0))[0], 4, 0).astype(int)
    )
    upper_left, lower_right = photo[18, 26], photo[30, 38]
    assert upper_left[0] > 100
    assert upper_left[2] > 100
    assert lower_right[0] < 100
    assert lower_right[2] < 100
