"""A scene photographed from farther away, through air."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.data import load_scene
from mrgs.errors import ConfigError
from mrgs.scene import RGB, THERMAL
from mrgs.scene.air import AirPath
from mrgs.scene.capture import Capture
from mrgs_synth.air import Air, through_air
from tests.helpers.scenes import write_scene


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A scene with a depth of 2 m everywhere, and metres."""
    folder = write_scene(tmp_path / "scene")
    (folder / "truth" / "depth").mkdir(parents=True)
    for photo in load_scene(folder).views:
        camera = photo.images[RGB].camera
        depth = np.full((camera.height, camera.width), 2.0, np.float32)
        Image.fromarray(depth).save(folder / "truth" / "depth" / f"{photo.name}.tiff")
    text = (folder / "transforms.json").read_text()
    units = '{"georeference": {"units": "metres", "axes": "arbitrary"}, '
    (folder / "transforms.json").write_text(units + text.removeprefix("{"))
    return folder


def test_everything_is_as_much_larger_and_reads_through_air(scene: Path, tmp_path: Path) -> None:
    before = load_scene(scene)
    assert through_air(scene, tmp_path / "far", metres=80.0) == pytest.approx(40.0)
    after = load_scene(tmp_path / "far")
    assert after.extent == pytest.approx(40 * before.extent, rel=1e-4)
    torch.testing.assert_close(after.points.positions, 40 * before.points.positions)
    truth = np.asarray(Image.open(tmp_path / "far/truth/depth" / f"{after.eval[0].name}.tiff"))
    np.testing.assert_allclose(truth, 80.0)
    one, two = (each.eval[0].images[THERMAL].load().values for each in (before, after))
    celsius, read = before.temperature.to_celsius(one), after.temperature.to_celsius(two)
    hot = celsius > celsius.median() + 5
    assert (read[hot] < celsius[hot] - 0.1).all(), "of 80 m of air of 10 °C"
    path = Capture.of(after).air
    assert isinstance(path, AirPath)


def test_at_the_distance_that_the_camera_is_set_to_it_reads_right() -> None:
    air, celsius = Air(), np.linspace(-20.0, 90.0, 12)
    np.testing.assert_allclose(air.read(celsius, np.full(12, air.noted_m)), celsius, atol=1e-6)
    np.testing.assert_array_equal(air.read(celsius, np.zeros(12)), celsius)
    far = air.read(celsius, np.full(12, 200.0))
    np.testing.assert_array_equal(far < celsius, celsius > air.celsius)


def test_what_is_missing_is_named(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="must be new"):
        through_air(scene, scene, metres=50.0)
    next((scene / "truth" / "depth").iterdir()).unlink()
    with pytest.raises(ConfigError, match="truth of all views"):
        through_air(scene, tmp_path / "far", metres=50.0)
