from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs import open_marks
from mrgs.errors import RunError
from mrgs.marks import Mark, Marks
from mrgs.marks.regions import Regions
from mrgs.marks.uncertainty import InputQuantity, Uncertainty, UncertaintyMeter
from mrgs.method.camera_model.image_model import ImageModel, ImageModelConfig
from mrgs.report import anomalies, report_run
from mrgs.report.anomalies import Proposals, find_spots, propose
from mrgs.report.sections import read_scores
from mrgs.report.texts import Texts
from mrgs.run_files.folder import RunFolder
from mrgs.runs.open import Run, load_run
from mrgs.scene import RGB, THERMAL, Box, Scene, View
from mrgs.scene.radiometry import ObjectParameters, PhotoRecord
from mrgs.survey import Survey, write_survey
from mrgs.training import make_config, train
from tests.helpers.changed_views import with_cameras
from tests.helpers.scenes import write_scene

METRICS = {
    "steps": 60,
    "mean": {
        "thermal": {"psnr": 41.239, "mae_c": 0.25, "lpips": None},
        "rgb": {"psnr": 27.4, "ssim": 0.84},
    },
}


class Doubting(UncertaintyMeter):
    """Knows every temperature to within some kelvin."""

    def __init__(self, kelvin: float) -> None:
        self.notes = ()
        self.kelvin = kelvin

    def of_mark(self, places, values, regions=None) -> Uncertainty:
        return Uncertainty(photos=self.kelvin, shared={InputQuantity("camera"): 100.0})


@pytest.fixture(scope="module", autouse=True)
def _proposed_by_any_difference() -> Iterator[None]:
    """The runs are trained for a moment, so that their ± is wide."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(anomalies, "LEAST_CERTAINTY", 1.0)
        patch.setattr(anomalies, "LARGEST_UNCERTAINTY_C", np.inf)
        yield


@pytest.fixture
def without_spots(run: Run) -> None:
    """For a report of other things, which is written sooner."""
    write_survey(run.folder.path / "survey.yaml", Survey(hot_places=0, cold_places=0))


class Page(HTMLParser):
    def __init__(self, path: Path) -> None:
        super().__init__()
        self.images: list[str] = []
        self.words: list[str] = []
        self.tags: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))

    def handle_starttag(self, tag, attributes):
        self.tags.add(tag)
        if tag == "img":
            self.images.append(dict(attributes)["src"])

    def handle_data(self, data):
        self.words.append(data)


@pytest.fixture(scope="module")
def plain(opened: Run, sharp: Scene, tmp_path_factory: pytest.TempPathFactory) -> Page:
    """The report of a run without marks, survey and scores."""
    return Page(report_run(opened, tmp_path_factory.mktemp("plain") / "report.html", scene=sharp))


def test_the_report_tells_spots_capture_training_and_limits(plain):
    for words in (
        "Hottest and coldest places", "H1", "x, y, z",
        "6 training", "8, 80 × 60", "10.0 °C", "30.0 °C",
        "Emissivity", "Reflections", "not covered", "photo reads",
    ):  # fmt: skip
        assert words in plain.text
    spots = [float(value) for value in re.findall(r"[HC]\d (\d+\.\d) ± \d+\.\d °C", plain.text)]
    assert spots
    assert all(5 < value < 35 for value in spots)


def test_everything_is_in_the_file(plain):
    assert plain.images
    assert all(source.startswith("data:image/") for source in plain.images)
    assert not plain.tags & {"script", "link", "iframe", "object"}


def test_the_appendix_is_there_where_it_is_asked_for(plain, run, tmp_path):
    asked = Page(report_run(run, tmp_path / "report.html", appendix=True)).text
    assert asked.count(f"mrgs eval {run.folder.path}") == 2
    for words in ("Not scored", "Appendix", "60 of 60"):
        assert words in asked
        assert words not in plain.text
    assert "mrgs eval" not in plain.text


@pytest.mark.usefixtures("without_spots")
def test_commands_in_the_report_can_be_pasted_whatever_the_folder_is_called(run, tmp_path):
    folder = tmp_path / "my $(run)"
    shutil.copytree(run.folder.path, folder)
    moved = replace(run, folder=RunFolder(folder))
    text = Page(report_run(moved, tmp_path / "report.html", appendix=True)).text
    assert text.count(f"mrgs eval '{folder}'") == 2


@pytest.mark.usefixtures("without_spots")
def test_scores_and_contact_sheet_are_shown(run, tmp_path):
    (run.folder.path / "eval" / "metrics.json").write_text(json.dumps(METRICS), encoding="utf-8")
    Image.new("RGB", (64, 32), (200, 10, 10)).save(run.folder.path / "eval" / "contact_sheet.png")
    page = Page(report_run(run, tmp_path / "report.html", appendix=True))
    assert "PSNR, dB 41.24" in page.text
    assert "RGB, SSIM 0.8400" in page.text
    assert "LPIPS" not in page.text
    assert "mrgs eval" not in page.text


@pytest.mark.usefixtures("without_spots")
def test_scores_with_aligned_poses_are_shown(run, tmp_path):
    poses = {
        "error_px": 1.7,
        "aligned": {"thermal": {"psnr": 49.876}, "rgb": {"psnr": 30.0}, "truth": {"mae_c": 0.1}},
    }
    (run.folder.path / "eval" / "metrics.json").write_text(
        json.dumps(METRICS | {"poses": poses}), encoding="utf-8"
    )
    path = report_run(run, tmp_path / "report.html", language="de", appendix=True)
    text = Page(path).text
    assert "PSNR, dB 49,88" in text
    assert "41,24" not in text
    assert "1,7 Pixel" in text


@pytest.mark.usefixtures("without_spots")
def test_scores_of_an_older_step_are_said_to_be_old(run, tmp_path):
    (run.folder.path / "eval" / "metrics.json").write_text(
        json.dumps(METRICS | {"steps": 30}), encoding="utf-8"
    )
    text = Page(report_run(run, tmp_path / "report.html", appendix=True)).text
    assert re.search(r"step 30\b.* step 60\b", text)


@pytest.mark.usefixtures("without_spots")
def test_foreign_metrics_are_named(run, tmp_path):
    file = run.folder.path / "eval" / "metrics.json"
    for content in (
        "{",
        "[]",
        '{"mean": {}}',
        '{"steps": 1, "mean": {"thermal": {"x": 1}, "rgb": {}}}',
    ):
        file.write_text(content, encoding="utf-8")
        with pytest.raises(RunError, match=r"metrics\.json .*`mrgs eval`"):
            read_scores(run, Texts())
    with pytest.raises(RunError, match=r"metrics\.json"):
        report_run(run, tmp_path / "report.html", appendix=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("without_spots")
def test_a_broken_contact_sheet_is_named(run, tmp_path):
    (run.folder.path / "eval" / "contact_sheet.png").write_bytes(b"not a picture")
    with pytest.raises(RunError, match=r"contact_sheet\.png .*`mrgs eval`"):
        report_run(run, tmp_path / "report.html", appendix=True)


@pytest.mark.usefixtures("without_spots")
def test_names_from_files_are_escaped(run, tmp_path):
    scene = run.load_scene()
    evil = "<script>alert(1)</script>"
    scene = replace(
        scene,
        name=evil,
        notes=(evil,),
        train=tuple(replace(view, name=evil + view.name) for view in scene.train),
    )
    page = Page(report_run(run, tmp_path / "report.html", scene=scene))
    assert "script" not in page.tags
    assert page.text.count("alert(1)") >= 3


def test_the_inspectors_words_are_escaped(run, tmp_path):
    evil = "\"><img src=x onerror=alert(1)></td></title><script>alert(2)</script>'&amp;"
    texts = [
        name
        for name, field in Survey.__dataclass_fields__.items()
        if field.type == "str | None" and name != "logo"
    ]
    assert len(texts) > 15
    survey = replace(
        Survey(standard="EN 13187", hot_places=0, cold_places=0), **dict.fromkeys(texts, evil)
    )
    write_survey(run.folder.path / "survey.yaml", survey)
    marks, camera = open_marks(run), run.load_scene().train[0].images[THERMAL].camera
    name = '"><script>x</script>'
    marks.line(camera, [(15, 15), (25, 15)], name=name, note=evil, severity="<img onerror=x>")
    marks.spot(camera, (20, 15))
    marks.refer_to(name)
    path = report_run(run, tmp_path / "report.html")
    page, html = Page(path), path.read_text(encoding="utf-8")
    assert "script" not in page.tags
    assert all(source.startswith("data:image/") for source in page.images)
    assert "onerror=alert(1)>" not in html
    assert " ".join(page.words).count("onerror=alert(1)>") >= len(texts)
    assert "<img onerror=x>" in page.text
    assert f"to {name}" in page.text


def test_a_scene_without_celsius_has_relative_values(run, sharp, tmp_path):
    unknown = replace(run, facts=run.facts._replace(temperature=None))
    scene = replace(sharp, temperature=None)
    text = Page(report_run(unknown, tmp_path / "report.html", scene=scene)).text
    assert "no °C" in text
    assert "were computed" not in text
    assert "Without °C" in text


@pytest.mark.parametrize(
    ("emissivity", "given", "said", "row"),
    [
        (
            0.7,
            {"emissivity": 0.7, "reflected_c": -10.0},
            "emissivity 0.70 (given",
            "emissivity 0.70; reflected",
        ),
        (0.95, {}, "emissivity 0.95 and", ""),
        (1.0, {}, "(emissivity 1.00)", ""),
    ],
)
@pytest.mark.usefixtures("without_spots")
def test_the_limits_say_what_the_temperatures_were_computed_with(
    run, tmp_path, emissivity, given, said, row
):
    parameters = ObjectParameters(emissivity, 2.5, -10.0, 20.0, 0.5)
    record = PhotoRecord(parameters=parameters, given=given)
    scene = run.load_scene()
    train, held_out = (
        tuple(
            replace(view, images={
                each: replace(image, record=record) for each, image in view.images.items()
            })
            for view in views
        )
        for views in (scene.train, scene.eval)
    )  # fmt: skip
    noted = replace(scene, train=train, eval=held_out)
    text = Page(report_run(run, tmp_path / "report.html", scene=noted)).text
    assert said in text
    assert row in text
    assert ("by the user" in text) == bool(given)
    assert "distance 2.5 m, air" in text


@pytest.mark.usefixtures("without_spots")
def test_photos_that_were_scaled_by_themselves_are_spoken_of(run, plain, tmp_path):
    scene = replace(run.load_scene(), temperature=None)
    capture = replace(run.facts.capture, has_celsius=False)
    unknown = replace(
        run,
        facts=run.facts._replace(temperature=None, capture=capture),
        image_model=ImageModel(ImageModelConfig(thermal_gain=True), capture),
    )
    assert "mean scale" in Page(report_run(unknown, tmp_path / "report.html", scene=scene)).text
    assert "mean scale" not in plain.text


@pytest.mark.usefixtures("without_spots")
def test_temperatures_that_depend_on_the_view_are_spoken_of(run, plain, tmp_path):
    gaussians = run.model.gaussians
    rest = torch.zeros(len(gaussians), 15, 1)
    gaussians = replace(gaussians, sh_rest=gaussians.sh_rest | {THERMAL: rest})
    changing = replace(run, model=replace(run.model, gaussians=gaussians))
    text = Page(report_run(changing, tmp_path / "report.html")).text
    assert "Viewpoint" in text
    assert "Viewpoint" not in plain.text


def test_a_model_without_surfaces_has_no_spots(run, plain, tmp_path):
    gaussians = run.model.gaussians
    mist = replace(
        gaussians,
        opacity_logits=dict.fromkeys((RGB, THERMAL), -4 + 0 * gaussians.opacity_logits[THERMAL]),
    )
    empty = replace(run, model=replace(run.model, gaussians=mist))
    text = Page(report_run(empty, tmp_path / "report.html")).text
    assert "Nothing stands out" in text
    assert "Nothing stands out" not in plain.text


@pytest.mark.filterwarnings("ignore:.*no temperatures")
def test_a_scene_without_thermal_photos_has_no_spots(tmp_path):
    folder = train(
        write_scene(tmp_path / "scene", thermal=False),
        tmp_path / "run",
        make_config("mrgs", max_steps=2, max_gaussians=60),
    )
    run = load_run(folder.path)
    assert "no thermal photos" in Page(report_run(run, tmp_path / "report.html")).text


@pytest.mark.usefixtures("without_spots")
def test_the_report_lists_the_marks_with_pictures_and_profile(run: Run, tmp_path: Path):
    marks, camera = open_marks(run), run.load_scene().train[0].images[THERMAL].camera
    marks.spot(camera, (20, 15), note="near the <middle>", severity="3")
    marks.line(camera, [(15, 15), (25, 15)])
    marks.box(camera, (16, 12), (24, 18), emissivity=0.8, reflected_c=-5.0)
    marks.refer_to("S1")
    readings = marks.measure()
    path = report_run(run, tmp_path / "report.html")
    page = Page(path)
    text = " ".join(page.words)
    assert "Measurements" in text
    for reading in readings:
        assert f"{reading.mean:.1f}" in text
    assert "near the <middle>" in text
    assert "severity: 3" in text
    assert re.search(r"ε 0\.8, +T_refl −5\.0 °C", text)
    assert text.count("Corrected for ε 0.8, T_refl −5.0 °C.") == 3  # spot and line lie in the box
    assert "apparent" in text
    assert "svg" in page.tags
    html = path.read_text(encoding="utf-8")
    for name in ("S1", "L1", "B1"):
        for picture in ("thermal", "photo", "plan"):
            assert html.count(f'alt="{name}, {picture}"') == 1


def test_proposals_are_kept_until_they_are_judged(run: Run, sharp: Scene, tmp_path: Path):
    marks = open_marks(run, sharp)

    def report() -> str:
        return Page(report_run(run, tmp_path / "report.html", scene=sharp)).text

    text, proposed = report(), marks.marks.proposals
    names = [mark.name for mark in proposed]
    assert len(names) >= 2
    assert f"--accept {names[0]}" in text
    accepted, dropped = names[:2]
    propose(marks, sharp, marks.meter.regions(marks.marks), Survey())
    assert marks.marks.proposals == proposed  # the same places have the same names
    marks.drop(dropped)
    marks.accept(accepted, severity="2", note="judged")
    text, known = report(), marks.marks
    assert "severity: 2" in text
    assert [mark.name for mark in known.marks] == [accepted]
    assert [mark.name for mark in known.dropped] == [dropped]
    judged = [mark.points[0] for mark in (*known.marks, *known.dropped)]
    for mark in known.proposals:
        assert mark.name not in (accepted, dropped)
        assert min(math.dist(mark.points[0], place) for place in judged) > mark.radius


@pytest.mark.slow
def test_proposals_in_a_region_have_its_emissivity(run: Run, sharp: Scene):
    marks, scene = open_marks(run, sharp), sharp
    found = propose(marks, scene, marks.meter.regions(marks.marks), Survey())
    name, (before, _, _) = next(iter(found.anomalies.items()))
    camera = scene.views[before.view].images[THERMAL].camera
    x, y = camera.project(torch.from_numpy(before.position))[0].tolist()
    marks.box(camera, (x - 2, y - 2), (x + 2, y + 2), emissivity=0.5, reflected_c=0.0)
    regions = marks.meter.regions(marks.marks)
    place = before.position[None]
    settings = regions.shares_at(place)[0].settings
    assert settings is not None
    apparent = scene.temperature.to_celsius(before.value)
    (expected,) = marks.meter.capture.corrected(np.array([apparent]), settings)
    (after, *_), _ = find_spots(scene.views, regions.render, ball=scene.reach)
    assert scene.temperature.to_celsius(after.value) == pytest.approx(expected, abs=0.1 * expected)
    assert expected > apparent + 5
    reading = next(each for each in marks.measure_proposals() if each.mark.name == name)
    assert reading.mean == pytest.approx(expected, abs=0.2 * expected)


def test_what_is_uncertain_by_more_than_it_differs_is_held_back(run: Run, sharp: Scene):
    marks, scene = open_marks(run, sharp), sharp
    regions = marks.meter.regions(marks.marks)
    marks.meter.uncertainty = Doubting(0.0)
    certain = propose(marks, scene, regions, Survey())
    assert len(certain.anomalies) >= 2
    assert certain.held_back == 0
    limit = min(abs(each.contrast) for each in certain.anomalies.values())
    marks.meter.uncertainty = Doubting(1.01 * limit)
    found = propose(marks, scene, regions, Survey())
    assert found.held_back >= 1
    assert all(abs(each.contrast) > limit for each in found.anomalies.values())
    marks.meter.uncertainty = Doubting(100.0)
    nothing = propose(marks, scene, regions, Survey())
    assert nothing.anomalies == {}
    assert nothing.held_back >= 2
    assert marks.marks.proposals == ()


@pytest.mark.slow
def test_the_survey_says_how_many_places_are_proposed(run: Run, sharp: Scene):
    marks = open_marks(run, sharp)
    regions = marks.meter.regions(marks.marks)

    def proposed(**counts: int) -> list[str]:
        found = propose(marks, sharp, regions, Survey(**counts)).anomalies
        return sorted(name[0] for name in found)

    assert proposed() == ["C", "H", "H"]
    assert proposed(hot_places=1) == ["C", "H"]
    assert proposed(cold_places=0) == ["H", "H"]
    assert proposed(hot_places=0) == ["C"]
    assert proposed(hot_places=0, cold_places=0) == []
    assert marks.marks.proposals == ()
    assert proposed(hot_places=20, cold_places=1).count("H") >= 2


def test_a_large_area_says_nothing_of_the_places_in_it(run: Run, sharp: Scene):
    marks, scene = open_marks(run, sharp), sharp
    found = propose(marks, scene, Regions(Marks(), run.render, None, marks.meter.capture), Survey())
    spot, reading, _ = next(iter(found.anomalies.values()))
    middle, radius = np.array(reading.mark.points[0]), reading.mark.radius
    square = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])

    def proposed(half: float) -> list[list[float]]:
        points = tuple(map(tuple, (middle + half * square).tolist()))
        box = Mark("Wall", "box", points, reading.mark.eye)
        marks.store.edit(lambda _: Marks((box,)))
        found = propose(marks, scene, marks.meter.regions(Marks()), Survey())
        return [each.spot.position.tolist() for each in found.anomalies.values()]

    assert spot.position.tolist() in proposed(half=100 * radius)
    assert spot.position.tolist() not in proposed(half=radius)


def test_the_report_says_how_many_are_held_back(run: Run, tmp_path: Path):
    """The photos of the run's own scene show something else than the globe."""
    text = Page(report_run(run, tmp_path / "report.html", language="de")).text
    assert re.search(r"Zurückgehalten\b[^:]*: [1-9]", text)
    assert "H1" not in text


@pytest.mark.parametrize(
    ("accuracy", "said", "not_said"),
    [
        ("", "would lie", "truth lies"),
        ("camera_accuracy_c: 1\n", "truth lies", "would lie"),
    ],
)
def test_the_report_promises_no_more_than_is_known_of_the_camera(
    run: Run, tmp_path: Path, accuracy: str, said: str, not_said: str
):
    marks, camera = open_marks(run), run.load_scene().train[0].images[THERMAL].camera
    marks.spot(camera, (20, 15))
    survey = f"{accuracy}hot_places: 0\ncold_places: 0\n"
    (run.folder.path / "survey.yaml").write_text(survey, encoding="utf-8")
    text = Page(report_run(run, tmp_path / "report.html")).text
    uncertainty = text[text.index("Uncertainty") :]
    assert said in uncertainty
    assert not_said not in uncertainty


def test_the_inspectors_words_are_printed_as_they_are(run: Run, tmp_path: Path):
    words = "dry since 12.03.2026"
    survey = run.folder.path / "survey.yaml"
    survey.write_text(
        f"standard: EN 13187\nprecipitation: {words}\nwind_m_s: 2.25\n"
        "hot_places: 0\ncold_places: 0\n",
        encoding="utf-8",
    )
    text = Page(report_run(run, tmp_path / "report.html", language="de")).text
    assert text.count(words) == 2
    assert text.count("2,25 m/s") == 2


def test_what_was_not_searched_for_is_not_said_to_be_missing(run: Run, tmp_path: Path):
    marks, camera = open_marks(run), run.load_scene().train[0].images[THERMAL].camera
    marks.spot(camera, (20, 15))
    survey = run.folder.path / "survey.yaml"
    survey.write_text("hot_places: 0\ncold_places: 0\n", encoding="utf-8")
    text = Page(report_run(run, tmp_path / "report.html")).text
    survey.write_text("hot_places: 0\n", encoding="utf-8")
    half = Page(report_run(run, tmp_path / "report.html")).text
    not_searched_for = re.compile(r"(Hot|Cold) places were not")
    assert not_searched_for.findall(text) == ["Hot", "Cold"]
    assert not_searched_for.findall(half) == ["Hot"]
    assert "stands out" not in text


@pytest.mark.usefixtures("without_spots")
def test_a_mark_without_temperature_keeps_its_note(run: Run, tmp_path: Path):
    marks, camera = open_marks(run), run.load_scene().train[0].images[THERMAL].camera
    marks.box(camera, (16, 12), (24, 18), emissivity=0.8, note="brass")
    page = report_run(run, tmp_path / "report.html")
    html = page.read_text(encoding="utf-8")
    assert re.search(r"reflected temperature;[^<]*\nbrass</td>", html)
    assert "Corrected for" not in html


def test_what_too_few_photos_see_is_no_proposal(run: Run, sharp: Scene):
    """Two photos of the training beside each other, then one that looks the other way."""

    def proposals(second: View) -> Proposals:
        scene = replace(sharp, train=(sharp.train[0], second))
        marks = open_marks(run, scene)
        marks.meter.uncertainty = Doubting(0.0)
        return propose(marks, scene, marks.meter.regions(marks.marks), Survey())

    beside = sharp.train[1]
    away = with_cameras(beside, lambda camera: camera.look_at(camera.position, 2 * camera.position))
    assert proposals(beside).anomalies
    found = proposals(away)
    assert (found.anomalies, found.held_back) == ({}, 0)


@pytest.mark.usefixtures("without_spots")
def test_a_cropped_model_is_reported_with_its_box(run, sharp, plain, tmp_path):
    cropped = run.cropped(Box((-0.5, -2.0, -2.0), (2.0, 2.0, 2.0)))
    page = Page(report_run(cropped, tmp_path / "report.html", "de", scene=sharp))
    assert "x, y, z von −0,5; −2; −2 bis 2; 2; 2" in page.text
    assert "Only a box" not in plain.text
