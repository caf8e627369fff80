"""Exports of a run of which an area has an emissivity of its own."""

from __future__ import annotations

import json
import re
import shutil

import numpy as np
import pytest
import torch
from torch import Tensor

from mrgs.export import export
from mrgs.export.job import correction_note
from mrgs.marks import open_marks
from mrgs.marks.regions import Regions
from mrgs.runs.baked import BakedModel
from mrgs.runs.open import load_run
from mrgs.scene import THERMAL, Camera, Rendering
from mrgs.scene.rendering import Blend
from mrgs.survey import SURVEY_FILE
from tests.helpers.exports import make_baked, read_ply

FORMATS = ("points", "mesh", "ply", "page")


@pytest.fixture(scope="module")
def exported(run, scene, tmp_path_factory):
    """The marks, and the folders without and with settings of the area."""
    folder = tmp_path_factory.mktemp("marked")
    shutil.copytree(run.folder.path, folder / "run")
    marks = open_marks(load_run(folder / "run"), scene)
    camera = scene.train_photos(THERMAL)[0].camera
    width, height = camera.width, camera.height
    low, high = ((share * width, share * height) for share in (0.4, 0.6))
    mark = marks.box(camera, low, high, "B1")
    export(marks.run, scene, FORMATS, folder / "without")
    marks.change(mark.name, emissivity=0.5, reflected_c=0.0)
    survey = marks.run.folder.path / SURVEY_FILE
    survey.write_text("inside_c: 22.5", encoding="utf-8")
    export(marks.run, scene, FORMATS, folder / "with")
    survey.unlink()
    return marks, folder / "without", folder / "with"


@pytest.mark.parametrize("name", ["points.ply", "mesh.ply"])
def test_what_cameras_see_of_it_is_corrected_and_nothing_else(exported, name):
    marks, without, own = exported
    plain, found = (read_ply(folder / name)[1]["vertex"] for folder in (without, own))
    before, after = plain["temperature_c"], found["temperature_c"]
    changed = after != before
    assert 0 < changed.sum() < 0.5 * len(changed)
    settings = marks.meter.capture.of_mark(marks.marks.marks[0])
    wanted = marks.meter.capture.corrected(before[changed].astype(np.float64), settings)
    np.testing.assert_allclose(after[changed], wanted, atol=1e-3)
    if "uncertainty_c" in found.dtype.names:
        larger = found["uncertainty_c"] > plain["uncertainty_c"]
        np.testing.assert_array_equal(larger, changed & ~np.isnan(found["uncertainty_c"]))
        at = np.stack([found[axis] for axis in "xyz"], axis=1)
        regions = marks.meter.regions(marks.marks)
        of_photos = marks.meter.uncertainty.of_points(at, before, regions)
        np.testing.assert_allclose(found["uncertainty_c"], of_photos, rtol=1e-5)


def test_files_say_how_exact_the_correction_is(exported):
    _, without, own = exported
    (of_splats, of_points, of_neither) = (
        json.loads(path.read_text(encoding="utf-8"))["temperature"].get("own_emissivity", "")
        for path in (
            own / "thermal.ply.json",
            own / "points.ply.json",
            without / "thermal.ply.json",
        )
    )
    assert "splat by splat" in of_splats
    assert re.search(r"\d\.\d °C", of_splats)
    assert "corrected" in of_points
    assert "splat" not in of_points
    assert of_neither == ""


def test_the_alarms_of_the_page_begin_with_what_the_survey_states(exported):
    pages = [(folder / "page.html").read_text("utf-8") for folder in exported[1:]]
    air = [json.loads(re.search(r'"air": ({[^}]*})', text)[1]) for text in pages]
    assert [each["inside_c"] for each in air] == [None, 22.5]


def test_the_page_corrects_what_is_seen_of_it(exported):
    _, without, own = exported
    plain, corrected = ((folder / "page.html").read_text("utf-8") for folder in (without, own))
    assert '"areas": null' in plain
    assert '"areas": {' in corrected
    assert "splat by splat" not in corrected
    of_splats = [re.findall(r'"data": "([^"]+)"', text) for text in (plain, corrected)]
    assert of_splats[0] == of_splats[1]


def test_the_error_of_the_correction_is_that_of_the_regions_pixels_in_kelvin():
    """Twenty pixels of a region are off by 0, 1, ... 19 hundredths of 20 K, in two views."""
    plain = torch.full((10, 40, 1), 0.5)
    exact = plain.clone()
    exact[0, :20] = 0.6
    blended = exact.clone()
    blended[0, :20, 0] += torch.arange(20) / 100 * torch.tensor([1, -1]).repeat(10)
    blended[5] = 0.0  # beside the region: of no interest

    def rendered(image: Tensor) -> Rendering:
        alpha = torch.ones(10, 40)
        return Rendering({THERMAL: Blend(image, alpha, alpha)})

    def model(image: Tensor) -> BakedModel:
        class Picture(BakedModel):
            def render(self, *_: object) -> Rendering:
                return rendered(image)

        return Picture(**vars(make_baked()))

    def regions(image: Tensor) -> Regions:
        class Correction(Regions):
            def applied_to(self, *_: object) -> Rendering:
                return rendered(image)

        return object.__new__(Correction)

    camera = Camera.from_fov(40, 10, 50)
    note = correction_note(model(plain), model(blended), regions(exact), [camera, camera])
    assert re.findall(r"\d[\d.]*\b", note) == ["1.9", "95", "3.6"]
    note = correction_note(model(plain), model(blended), regions(plain), [camera])
    assert not re.search(r"\d", note)
