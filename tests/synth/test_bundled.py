"""The scene that comes with the project is whole, small, and agrees with its truth."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from mrgs.scene import Camera, TemperatureRange
from mrgs_synth.generate import RAYS_PER_SIDE
from mrgs_synth.hits import Triangles, first_hits
from mrgs_synth.radiometry import exact_temperature
from mrgs_synth.sensor import ThermalSensor, quantise
from mrgs_synth.stage import Stage
from mrgs_synth.tracer import PathTracer

SCENE = Path(__file__).parents[2] / "examples" / "tabletop"
EVAL_NAMES = [f"frame_eval_{number:05d}" for number in range(1, 9)]


def read(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


@pytest.fixture(scope="module")
def transforms() -> dict:
    return json.loads((SCENE / "transforms.json").read_text())


def test_it_is_whole_and_small(transforms: dict) -> None:
    assert sum(path.stat().st_size for path in SCENE.rglob("*") if path.is_file()) < 8_000_000
    names = [Path(frame["file_path"]).stem for frame in transforms["frames"]]
    assert sum("_train_" in name for name in names) == 40
    assert [name for name in names if "_eval_" in name] == EVAL_NAMES
    for frame in transforms["frames"]:
        assert read(SCENE / frame["file_path"]).shape == (240, 320, 3)
        assert read(SCENE / frame["thermal_file_path"]).shape == (240, 320)


@pytest.mark.parametrize("name", EVAL_NAMES)
def test_thermal_images_agree_with_the_exact_temperatures(name: str) -> None:
    bounds = json.loads((SCENE / "temperature_bounds.json").read_text())
    low, high = bounds["absolute_min_temperature"], bounds["absolute_max_temperature"]
    celsius = low + read(SCENE / f"thermal/{name}.png") / 255.0 * (high - low)
    exact = read(SCENE / f"truth/temperature/{name}.tiff")
    assert (
        np.median(np.abs(celsius - exact)) < 0.2
    )  # noise and rounding; the blur of outlines is in the mean
    assert 0.1 < np.abs(celsius - exact).mean() < 0.6


def test_depths_of_neighbouring_views_agree(transforms: dict) -> None:
    """A surface point found through one view's depth lies where another view's depth says, unless
    it is hidden."""
    poses = {
        Path(f["file_path"]).stem: np.array(f["transform_matrix"]) for f in transforms["frames"]
    }
    v, u = np.mgrid[0:240, 0:320] + 0.5
    focal = np.array([transforms["fl_x"], transforms["fl_y"]])
    centre = np.array([transforms["cx"], transforms["cy"]])
    rays = np.concatenate(
        [(np.stack([u, v], axis=-1) - centre) / focal, np.ones((240, 320, 1))], axis=-1
    )
    for first, second in pairwise(EVAL_NAMES):
        to_world, to_second = poses[first], np.linalg.inv(poses[second])
        opencv = np.diag([1.0, -1.0, -1.0])
        points = (rays * read(SCENE / f"truth/depth/{first}.tiff")[..., None]).reshape(-1, 3)
        world = points @ opencv @ to_world[:3, :3].T + to_world[:3, 3]
        seen = (world @ to_second[:3, :3].T + to_second[:3, 3]) @ opencv
        pixel = np.floor(seen[:, :2] / seen[:, 2:] * focal + centre).astype(int)
        inside = (seen[:, 2] > 0) & ((pixel >= 0) & (pixel < [320, 240])).all(axis=1)
        depth = read(SCENE / f"truth/depth/{second}.tiff")[pixel[inside, 1], pixel[inside, 0]]
        error = (seen[inside, 2] - depth) / depth
        assert inside.mean() > 0.4
        assert np.median(np.abs(error)) < 0.005
        assert (
            np.mean(error < -0.03) < 0.02
        )  # nothing stands before what the second view sees first


def third_eval_camera(table: Stage) -> Camera:
    rng = np.random.default_rng([0, 3])
    table.cameras.train(40, 320, 240, rng)
    return table.cameras.between(len(EVAL_NAMES), 40, 320, 240, rng)[2]


def test_the_generator_still_makes_this_scene(table: Stage, transforms: dict) -> None:
    train_count = 40
    camera = third_eval_camera(table)
    pose = np.array(transforms["frames"][train_count + 2]["transform_matrix"])
    np.testing.assert_allclose(camera.position.numpy(), pose[:3, 3], atol=1e-9)
    triangles = Triangles.of(table.solids)
    exact_c = exact_temperature(camera, table, triangles, RAYS_PER_SIDE)
    depth_m = first_hits(camera, triangles).depth_m
    bounds = json.loads((SCENE / "temperature_bounds.json").read_text())
    low, high = bounds["absolute_min_temperature"], bounds["absolute_max_temperature"]
    thermal = ThermalSensor().photograph(exact_c, train_count + 2, seed=0)
    grey = quantise(thermal, TemperatureRange(low, high)).astype(int)
    assert np.mean(grey != read(SCENE / f"thermal/{EVAL_NAMES[2]}.png")) < 1e-3
    # Another processor may round a ray to the other side of an outline.
    assert (
        np.mean(np.abs(exact_c - read(SCENE / f"truth/temperature/{EVAL_NAMES[2]}.tiff")) > 0.01)
        < 1e-3
    )
    assert (
        np.mean(np.abs(depth_m - read(SCENE / f"truth/depth/{EVAL_NAMES[2]}.tiff")) > 0.001) < 1e-3
    )


def test_the_generator_still_paints_this_scene(tmp_path: Path, table: Stage) -> None:
    """With fewer paths the photo is noisier than the bundled one, but nothing in it has another
    colour or place."""
    pytest.importorskip("mitsuba", reason="the extra synth is not installed")
    photo = PathTracer(table, tmp_path).photograph(third_eval_camera(table), samples=4, seed=0)
    bundled = read(SCENE / f"images/{EVAL_NAMES[2]}.jpg")
    blurred = [gaussian_filter(image.astype(float), (3, 3, 0)) for image in (photo, bundled)]
    difference = np.abs(blurred[0] - blurred[1]).mean(axis=2)
    assert difference.mean() < 2.5
    assert np.quantile(difference, 0.995) < 12.0
