from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from mrgs.export import export
from mrgs.export.job import comment_lines, described, facts_of
from mrgs.maps.options import MapOptions
from mrgs.maps.surfaces import up_direction
from mrgs.rasterizer.contract import Dilation
from mrgs.scene import RGB, THERMAL, Box, Camera, View, WorldFrame
from tests.helpers.exports import make_baked, read_ply


def test_the_facts_say_units_axes_range_and_loss(scene):
    facts = facts_of(make_baked(), scene, np.array([0.0, 0.0, 1.0]), {RGB: 0.12, THERMAL: 0.0})
    assert (
        facts["temperature"].items()
        >= {"property": "temperature_c", "unit": "°C", "min": 10.0, "max": 30.0}.items()
    )
    assert facts["baking_loss_db"] == {"rgb": 0.12, "thermal": 0.0}
    assert facts["up"] == [0.0, 0.0, 1.0]
    assert facts["program"].startswith("mrgs ")
    assert "OpenCV" in facts["camera_axes"]
    assert "adds 0.3 px²" in facts["opacities"]
    other = facts_of(replace(make_baked(), dilation=Dilation(0.1)), scene, None, None)
    assert "adds 0.1 px²" in other["opacities"]
    assert other["dilation"] == {"px2": 0.1, "finest_focal_px": None}
    angular = facts_of(replace(make_baked(), dilation=Dilation(0.1, 755.6)), scene, None, None)
    for part in ("0.1 px² · (f / 756)²", "below 756 px", "least 0.01 px²"):
        assert part in angular["opacities"]
    assert angular["dilation"] == {"px2": 0.1, "finest_focal_px": 755.6}


def test_what_is_not_known_is_null(scene):
    facts = facts_of(make_baked(temperature=None), scene, None, None)
    assert (facts["up"], facts["baking_loss_db"]) == (None, None)
    assert "no °C" in facts["temperature"]["unit"]


def test_the_sidecar_is_json_beside_the_file(tmp_path):
    _, path = described(tmp_path / "rgb.spz", {"unit": "°C"})
    assert path == tmp_path / "rgb.spz.json"
    assert json.loads(path.read_text(encoding="utf-8")) == {"file": "rgb.spz", "unit": "°C"}


def test_facts_become_header_lines():
    assert comment_lines({"unit": "m", "of": [1]}) == ["unit: m", "of: [1]"]


def test_up_is_across_the_horizontal_axes_of_level_cameras(scene):
    np.testing.assert_allclose(up_direction(scene), [0, 0, 1], atol=1e-9)


def turned(scene, roll):
    """The scene with each camera rolled about its own axis."""

    def rolled(index, image):
        cosine, sine = math.cos(roll(index)), math.sin(roll(index))
        turn = torch.eye(4, dtype=torch.float64)
        turn[:2, :2] = torch.tensor([[cosine, -sine], [sine, cosine]])
        camera = image.camera
        return replace(
            image, camera=Camera(camera.K, turn @ camera.viewmat, camera.width, camera.height)
        )

    views = (
        View(view.name, {RGB: rolled(i, view.images[RGB])}) for i, view in enumerate(scene.train)
    )
    return replace(scene, train=tuple(views))


def test_cameras_that_are_held_almost_level_tell_which_way_is_up(scene):
    tilted = turned(scene, lambda i: 0.1 * (-1) ** i)
    assert up_direction(tilted) @ [0, 0, 1] > 0.99


@pytest.mark.parametrize("roll", [lambda i: 1.0 * i, lambda i: 0.3 * (-1) ** i, lambda i: 0.0])
def test_up_is_not_guessed(scene, roll):
    case = turned(scene, roll)
    if roll(1) == 0:  # one camera's horizontal axis fits any up
        case = replace(case, train=case.train[:1])
    assert up_direction(case) is None


def test_an_export_says_what_is_left_out(run, scene, tmp_path):
    means = run.model.gaussians.means
    box = Box.between(*means.amin(dim=0).tolist(), *means.median(dim=0).values.tolist())
    cropped = run.cropped(box)
    export(cropped, scene, "ply", tmp_path)
    facts = json.loads((tmp_path / "rgb.ply.json").read_text(encoding="utf-8"))
    assert facts["splats"] == len(means) - facts["crop"]["splats_left_out"] < len(means)
    assert facts["crop"]["high"] == list(box.high)
    assert "crop" not in facts_of(make_baked(), scene, None, None)


def test_maps_and_points_show_what_is_within_the_outline(run, scene, tmp_path):
    rasterio = pytest.importorskip("rasterio")
    metric = replace(scene, world=WorldFrame(metric=True))
    outline = [(-9.0, -9.0), (0.0, -9.0), (0.0, 9.0), (-9.0, 9.0)]
    ends = {}
    for name, model in (("whole", run), ("part", run.cropped(Box.around([outline], -9, 9)))):
        options = MapOptions(pixel_size_m=0.05)
        export(model, metric, ["ortho", "points"], tmp_path / name, maps=options)
        with rasterio.open(tmp_path / name / "ortho.tif") as file:
            x = np.array(file.xy(*np.isfinite(file.read(1)).nonzero())[0])
        points = read_ply(tmp_path / name / "points.ply")[1]["vertex"]["x"]
        ends[name] = x.min(), points.min(), x.max(), points.max()
    assert ends["part"][:2] == ends["whole"][:2]
    assert min(ends["whole"][2:]) > 0.3 > 0.2 > max(ends["part"][2:])
