from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from mrgs.errors import ConfigError
from mrgs.scene import Camera
from mrgs_synth.cameras import look_at, pinhole
from mrgs_synth.colors import to_srgb
from mrgs_synth.hits import Triangles, first_hits
from mrgs_synth.shapes import box
from mrgs_synth.stage import Stage
from mrgs_synth.tracer import PathTracer, load_mitsuba


def test_srgb_curve() -> None:
    assert to_srgb(np.array([-1.0, 0.0, 0.002, 0.2140, 1.0, 7.0])).tolist() == [
        0,
        0,
        7,
        127,
        255,
        255,
    ]


def test_missing_mitsuba_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(ConfigError, match=r"\[synth\]"):
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


def test_the_meter_keeps_bright_and_dark_scenes_visible(tmp_path: Path, two_boxes: Stage) -> None:
    pytest.importorskip("mitsuba", reason="the extra synth is not installed")
    cameras = two_boxes.cameras.train(2, 64, 48, np.random.default_rng(0))
    means = []
    for factor in (0.01, 30.0):
        lamp = dataclasses.replace(two_boxes.lamps[0], radiance=(factor, factor, factor))
        stage = dataclasses.replace(two_boxes, lamps=(lamp,), sky=None, exposure=None)
        tracer = PathTracer(stage, tmp_path)
        exposure = tracer.meter(cameras, seed=0)
        photo = tracer.photograph(cameras[0], samples=8, seed=0)
        means.append(photo.mean())
        assert (photo > 250).all(axis=-1).mean() < 0.1
    assert exposure < 1.0
    assert 70.0 < means[0] < 170.0
    assert means[0] == pytest.approx(means[1], abs=3.0)


def test_a_panorama_is_seen_where_it_should_be(tmp_path: Path, two_boxes: Stage) -> None:
    pytest.importorskip("mitsuba", reason="the extra synth is not installed")
    sky = np.zeros((64, 128, 3))
    sky[:8], sky[24:32, 28:36], sky[24:32, 60:68] = (
        (1.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 1.0),
    )
    stage = dataclasses.replace(two_boxes, lamps=(), sky=sky)
    tracer = PathTracer(stage, tmp_path)
    above = np.tan(np.radians(11.25))  # the elevation of the rows 24 to 32
    for direction, colour in (
        ((0.0, 0.01, 1.0), 0),
        ((1.0, 0.0, above), 1),
        ((0.0, -1.0, above), 2),
    ):
        position = np.array([0.0, 0.0, 5.0])
        viewmat = torch.from_numpy(look_at(position, position + np.array(direction)))
        camera = Camera(pinhole(6.0, 32, 24), viewmat, 32, 24)
        middle = tracer.photograph(camera, 4, 0)[8:16, 10:22].reshape(-1, 3).mean(axis=0)
        assert middle[colour] > 200.0
        assert np.delete(middle, colour).max() < 20.0


def test_texture_stands_upright(tmp_path: Path, two_boxes: Stage) -> None:
    pytest.importorskip("mitsuba", reason="the extra synth is not installed")
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
        stage.cameras,
        rings=((5.0, 1.0),),
        azimuth_deg=(0.0, 0.0),
        jitter_m=0.0,
        target=(0.0, 0.0, 0.2),
    )
    photo = (
        PathTracer(stage, tmp_path)
        .photograph(camera.train(1, 64, 48, np.random.default_rng(0))[0], 4, 0)
        .astype(int)
    )
    upper_left, lower_right = photo[18, 26], photo[30, 38]
    assert upper_left[0] > 100
    assert upper_left[2] > 100
    assert lower_right[0] < 100
    assert lower_right[2] < 100
