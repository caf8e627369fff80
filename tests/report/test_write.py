from __future__ import annotations

import json
import math
import re
import shutil
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
from mrgs.marks.measure import MarkMeter
from mrgs.marks.regions import Regions
from mrgs.marks.uncertainty import Uncertainty, UncertaintyMeter
from mrgs.method.camera_model.image_model import ImageModel, ImageModelConfig
from mrgs.report import write_report
from mrgs.report.proposals import propose
from mrgs.report.spots import find_spots
from mrgs.runs.open import Run, load_run
from mrgs.scene import THERMAL
from mrgs.scene.radiometry import ObjectParameters, PhotoRecord
from mrgs.survey import Survey, write_survey
from mrgs.training import make_config, train
from mrgs.training.run_folder import RunFolder
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

    def of_mark(self, points, value, surface=None) -> Uncertainty:
        return Uncertainty(photos=self.kelvin, camera=100.0)


@pytest.fixture
def certain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Temperatures that are known well, which 60 steps do not give."""
    monkeypatch.setattr(UncertaintyMeter, "of_run", lambda run, scene: Doubting(0.001))


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


@pytest.mark.usefixtures("certain")
def test_the_report_tells_spots_capture_training_and_limits(run, tmp_path):
    page = Page(write_report(run, run.load_scene(), tmp_path / "report.html"))
    for words in (
        "Anomalies found by the program", "H1", "position x, y, z",
        "6 training, 2 evaluation", "8, 40 × 30 pixels", "10.0 °C to 30.0 °C",
        "not in the scene's files",
        "60 of 60", "Emissivity", "Reflections", "not covered by photos",
        "The thermal photo reads",
    ):  # fmt: skip
        assert words in page.text
    spots = [float(value) for value in re.findall(r"[HC]\d (\d+\.\d) ± \d+\.\d °C", page.text)]
    assert spots
    assert all(5 < value < 35 for value in spots)


@pytest.mark.usefixtures("certain")
def test_everything_is_in_the_file(run, tmp_path):
    page = Page(write_report(run, run.load_scene(), tmp_path / "report.html"))
    assert page.images
    assert all(source.startswith("data:image/") for source in page.images)
    assert not page.tags & {"script", "link", "iframe", "object"}


def test_without_scores_it_says_how_to_get_them(run, tmp_path):
    text = Page(write_report(run, run.load_scene(), tmp_path / "report.html")).text
    assert text.count(f"mrgs eval {run.folder.path}") == 2
    assert "Not scored yet" in text
    assert "No contact sheet yet" in text


def test_commands_in_the_report_can_be_pasted_whatever_the_folder_is_called(run, tmp_path):
    folder = tmp_path / "my $(run)"
    shutil.copytree(run.folder.path, folder)
    moved = replace(run, folder=RunFolder(folder))
    text = Page(write_report(moved, run.load_scene(), tmp_path / "report.html")).text
    assert text.count(f"mrgs eval '{folder}'") == 2


def test_scores_and_contact_sheet_are_shown(run, tmp_path):
    (run.folder.path / "eval" / "metrics.json").write_text(json.dumps(METRICS), encoding="utf-8")
    Image.new("RGB", (64, 32), (200, 10, 10)).save(run.folder.path / "eval" / "contact_sheet.png")
    page = Page(write_report(run, run.load_scene(), tmp_path / "report.html"))
    assert "Thermal, PSNR, dB 41.24" in page.text
    assert "RGB, SSIM 0.8400" in page.text
    assert "LPIPS" not in page.text
    assert "mrgs eval" not in page.text


def test_where_poses_are_wrong_the_scores_are_those_with_aligned_ones(run, tmp_path):
    poses = {
        "error_px": 1.7,
        "aligned": {"thermal": {"psnr": 49.876}, "rgb": {"psnr": 30.0}, "truth": {"mae_c": 0.1}},
    }
    (run.folder.path / "eval" / "metrics.json").write_text(
        json.dumps(METRICS | {"poses": poses}), encoding="utf-8"
    )
    text = Page(write_report(run, run.load_scene(), tmp_path / "report.html", language="de")).text
    assert "PSNR, dB 49,88" in text
    assert "41,24" not in text
    assert "Ein typisches Foto liegt 1,7 Pixel neben dem, was das Modell zeigt" in text


def test_what_the_parts_of_the_model_add_is_shown(run, tmp_path):
    parts = {
        "temperature_residual_std_c": 0.51239,
        "heat_exchange_std_c": 0.0,
        "color_residual_std": None,
        "knock_out": {
            "temperature_residual": {"thermal_psnr": 38.456, "rgb_psnr": 27.4, "truth_mae_c": None}
        },
    }
    (run.folder.path / "eval" / "metrics.json").write_text(
        json.dumps(METRICS | {"parts": parts}), encoding="utf-8"
    )
    text = Page(write_report(run, run.load_scene(), tmp_path / "report.html", language="de")).text
    assert "Temperaturanteil t̂ des Feldes 0,5124 °C" in text
    assert "Wärmeaustausch 0,0000 °C" in text
    assert "Farbanteil" not in text
    assert "t̂ für alle gleich 38,46 27,40 –" in text


def test_scores_of_an_older_step_are_said_to_be_old(run, tmp_path):
    (run.folder.path / "eval" / "metrics.json").write_text(
        json.dumps(METRICS | {"steps": 30}), encoding="utf-8"
    )
    text = Page(write_report(run, run.load_scene(), tmp_path / "report.html")).text
    assert "Scored at step 30, but the model is now at step 60" in text


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        '{"mean": {}}',
        '{"steps": 1, "mean": {"thermal": {"x": 1}, "rgb": {}}}',
        '{"steps": 1, "mean": {}, "parts": {"heat_exchange_std_c": "much"}}',
        '{"steps": 1, "mean": {}, "parts": {"knock_out": {"unknown": {}}}}',
    ],
)
def test_foreign_metrics_are_named(run, tmp_path, content):
    (run.folder.path / "eval" / "metrics.json").write_text(content, encoding="utf-8")
    with pytest.raises(
        RunError, match=r"metrics\.json is not what `mrgs eval` writes .*; run `mrgs eval` again"
    ):
        write_report(run, run.load_scene(), tmp_path / "report.html")
    assert not list(tmp_path.iterdir())


def test_a_broken_contact_sheet_is_named(run, tmp_path):
    (run.folder.path / "eval" / "contact_sheet.png").write_bytes(b"not a picture")
    with pytest.raises(
        RunError, match=r"contact_sheet\.png cannot be read .*; run `mrgs eval` again"
    ):
        write_report(run, run.load_scene(), tmp_path / "report.html")


def test_names_from_files_are_escaped(run, tmp_path):
    scene = run.load_scene()
    evil = "<script>alert(1)</script>"
    scene = replace(
        scene,
        name=evil,
        notes=(evil,),
        train=tuple(replace(view, name=evil + view.name) for view in scene.train),
    )
    page = Page(write_report(run, scene, tmp_path / "report.html"))
    assert "script" not in page.tags
    assert page.text.count("alert(1)") >= 3


def test_the_inspectors_words_are_escaped(run, tmp_path):
    evil = "\"><img src=x onerror=alert(1)></td></title><script>alert(2)</script>'&amp;"
    texts = [
        name for name, field in Survey.__dataclass_fields__.items() if field.type == "str | None"
    ]
    assert len(texts) > 15
    survey = replace(Survey(standard="EN 13187"), **dict.fromkeys(texts, evil))
    write_survey(run.folder.path / "survey.yaml", survey)
    marks, camera = open_marks(run), run.load_scene().train[0].images[THERMAL].camera
    name = '"><script>x</script>'
    marks.line(camera, [(15, 15), (25, 15)], name=name, note=evil, severity="<img onerror=x>")
    marks.spot(camera, (20, 15))
    marks.refer_to(name)
    path = write_report(run, run.load_scene(), tmp_path / "report.html")
    page, html = Page(path), path.read_text(encoding="utf-8")
    assert "script" not in page.tags
    assert all(source.startswith("data:image/") for source in page.images)
    assert "onerror=alert(1)>" not in html
    assert " ".join(page.words).count("onerror=alert(1)>") >= len(texts)
    assert "<img onerror=x>" in page.text
    assert f"to {name}" in page.text


@pytest.mark.usefixtures("certain")
def test_a_scene_without_celsius_has_relative_values(run, tmp_path):
    unknown = replace(run, facts=run.facts._replace(temperature=None))
    scene = replace(run.load_scene(), temperature=None)
    text = Page(write_report(unknown, scene, tmp_path / "report.html")).text
    assert "There are no °C" in text
    assert "temperatures were computed" not in text
    assert "Without °C this cannot be corrected" in text
    assert re.search(r"H1 \d\.\d{3}", text)


@pytest.mark.parametrize(
    ("emissivity", "given", "said", "row"),
    [
        (
            0.7,
            {"emissivity": 0.7, "reflected_c": -10.0},
            "computed with emissivity 0.70 (given by the user) and reflected temperature −10.0 °C "
            "(given by the user);",
            "Of these, given by the user emissivity 0.70; reflected temperature −10.0 °C",
        ),
        (0.95, {}, "computed with emissivity 0.95 and reflected temperature −10.0 °C;", ""),
        (1.0, {}, "the temperatures are apparent ones (emissivity 1.00);", ""),
    ],
)
@pytest.mark.usefixtures("certain")
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
    text = Page(write_report(run, noted, tmp_path / "report.html")).text
    assert said in text
    assert row in text
    assert ("given by the user" in text) == bool(given)
    assert "computed with distance 2.5 m, air temperature 20.0 °C and relative" in text


def test_photos_that_were_scaled_by_themselves_are_spoken_of(run, tmp_path):
    scene = replace(run.load_scene(), temperature=None)
    capture = run.facts.capture._replace(has_celsius=False)
    unknown = replace(
        run,
        facts=run.facts._replace(temperature=None, capture=capture),
        image_model=ImageModel(ImageModelConfig(thermal_gain=True), capture),
    )
    assert "mean scale" in Page(write_report(unknown, scene, tmp_path / "report.html")).text
    assert (
        "mean scale" not in Page(write_report(run, run.load_scene(), tmp_path / "other.html")).text
    )


def test_temperatures_that_depend_on_the_view_are_spoken_of(run, tmp_path):
    gaussians = run.model.gaussians
    rest = torch.zeros(len(gaussians), 15, 1)
    gaussians = replace(gaussians, sh_rest=gaussians.sh_rest | {THERMAL: rest})
    changing = replace(run, model=replace(run.model, gaussians=gaussians))
    scene = run.load_scene()
    assert "Viewpoint" in Page(write_report(changing, scene, tmp_path / "report.html")).text
    assert "Viewpoint" not in Page(write_report(run, scene, tmp_path / "other.html")).text


def test_a_model_without_surfaces_has_no_spots(trained, tmp_path):
    run = load_run(trained)
    with torch.no_grad():
        run.model.gaussians.opacity_logits[THERMAL].fill_(-4)
    assert (
        "Nothing stands out on surfaces that enough views see"
        in Page(write_report(run, run.load_scene(), tmp_path / "r.html")).text
    )


def test_a_scene_without_thermal_photos_has_no_spots(tmp_path):
    folder = train(
        write_scene(tmp_path / "scene", thermal=False),
        tmp_path / "run",
        make_config("mrgs", max_steps=2, max_gaussians=60),
    )
    run = load_run(folder.path)
    assert (
        "no thermal photos"
        in Page(write_report(run, run.load_scene(), tmp_path / "report.html")).text
    )


def test_the_report_lists_the_marks_with_pictures_and_profile(run: Run, tmp_path: Path):
    marks, camera = open_marks(run), run.load_scene().train[0].images[THERMAL].camera
    marks.spot(camera, (20, 15), note="near the <middle>", severity="3")
    marks.line(camera, [(15, 15), (25, 15)])
    marks.box(camera, (16, 12), (24, 18), emissivity=0.8, reflected_c=-5.0)
    marks.refer_to("S1")
    readings = marks.measure()
    path = write_report(run, run.load_scene(), tmp_path / "report.html")
    page = Page(path)
    text = " ".join(page.words)
    assert "Measurements" in text
    for reading in readings:
        assert f"{reading.mean:.1f}" in text
    assert "near the <middle>" in text
    assert "severity: 3" in text
    assert re.search(r"ε 0\.8, +T_refl −5\.0 °C", text)
    assert text.count("Corrected for ε 0.8, T_refl −5.0 °C.") == 3  # spot and line lie in the box
    assert "temperatures are taken as apparent ones" in text
    assert "svg" in page.tags
    html = path.read_text(encoding="utf-8")
    for name in ("S1", "L1", "B1"):
        for picture in ("thermal", "photo", "plan"):
            assert html.count(f'alt="{name}, {picture}"') == 1


@pytest.mark.usefixtures("certain")
def test_proposals_are_kept_until_they_are_judged(run: Run, tmp_path: Path):
    marks, scene = open_marks(run), run.load_scene()

    def report() -> str:
        return Page(write_report(run, scene, tmp_path / "report.html")).text

    text, proposed = report(), marks.marks.proposals
    names = [mark.name for mark in proposed]
    assert len(names) >= 2
    assert f"mrgs measure --accept {names[0]}" in text
    report()
    assert marks.marks.proposals == proposed  # the same places have the same names
    accepted, dropped = names[:2]
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
    marks.undo()


@pytest.mark.usefixtures("certain")
def test_proposals_in_a_region_have_its_emissivity(run: Run):
    marks, scene = open_marks(run), run.load_scene()
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


def test_what_is_uncertain_by_more_than_it_differs_is_held_back(run: Run):
    marks, scene = open_marks(run), run.load_scene()
    regions = marks.meter.regions(marks.marks)
    marks.meter.uncertainty = Doubting(0.0)
    certain = propose(marks, scene, regions, Survey())
    assert len(certain.anomalies) >= 2
    assert certain.held_back == 0
    limit = min(abs(each.contrast) for each in certain.anomalies.values())
    marks.meter.uncertainty = Doubting(limit)
    found = propose(marks, scene, regions, Survey())
    assert found.held_back >= 1
    assert all(abs(each.contrast) > limit for each in found.anomalies.values())
    marks.meter.uncertainty = Doubting(100.0)
    nothing = propose(marks, scene, regions, Survey())
    assert nothing.anomalies == {}
    assert nothing.held_back >= 2
    assert marks.marks.proposals == ()


@pytest.mark.usefixtures("certain")
def test_the_survey_says_how_many_places_are_proposed(run: Run, monkeypatch: pytest.MonkeyPatch):
    marks, scene = open_marks(run), run.load_scene()
    regions = marks.meter.regions(marks.marks)
    measured = []

    def counted(views, render, count, *rest):
        measured.append(count)
        return find_spots(views, render, count, *rest)

    monkeypatch.setattr("mrgs.report.proposals.find_spots", counted)

    def proposed(**counts: int) -> set[str]:
        return {name[0] for name in propose(marks, scene, regions, Survey(**counts)).anomalies}

    assert proposed() == {"H", "C"}
    assert proposed(cold_places=0) == {"H"}
    assert proposed(hot_places=0) == {"C"}
    assert proposed(hot_places=0, cold_places=0) == set()
    assert marks.marks.proposals == ()
    proposed(hot_places=20)
    assert measured == [6, 6, 6, 0, 40]


@pytest.mark.usefixtures("certain")
def test_a_large_area_says_nothing_of_the_places_in_it(run: Run):
    marks, scene = open_marks(run), run.load_scene()
    found = propose(marks, scene, Regions(Marks(), run.render, None, marks.meter.capture), Survey())
    name, (spot, reading, _) = next(iter(found.anomalies.items()))
    middle, radius = np.array(reading.mark.points[0]), reading.mark.radius
    square = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])

    def proposed(half: float) -> tuple[str, ...]:
        points = tuple(map(tuple, (middle + half * square).tolist()))
        box = Mark("Wall", "box", points, reading.mark.eye)
        marks.store.edit(lambda _: Marks((box,)))
        return tuple(propose(marks, scene, marks.meter.regions(Marks()), Survey()).anomalies)

    assert name in proposed(half=100 * radius)
    assert spot.position.tolist() not in [
        list(mark.points[0]) for mark in marks.marks.proposals if proposed(half=radius)
    ]


def test_the_report_says_how_many_are_held_back(run: Run, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(UncertaintyMeter, "of_run", lambda run, scene: Doubting(100.0))
    text = Page(write_report(run, run.load_scene(), tmp_path / "report.html", language="de")).text
    assert re.search(r"Zurückgehalten, .* gemeinsam haben\): \d+\.", text)
    assert "H1" not in text


@pytest.mark.parametrize(
    ("accuracy", "said", "not_said"),
    [
        ("", "If the thermal camera itself had no error, the truth would lie within", "The truth"),
        ("camera_accuracy_c: 1", "The truth lies within ± in 95 of 100 cases.", "had no error"),
    ],
)
def test_the_report_promises_no_more_than_is_known_of_the_camera(
    run: Run, tmp_path: Path, accuracy: str, said: str, not_said: str
):
    marks, camera = open_marks(run), run.load_scene().train[0].images[THERMAL].camera
    marks.spot(camera, (20, 15))
    (run.folder.path / "survey.yaml").write_text(accuracy, encoding="utf-8")
    text = Page(write_report(run, run.load_scene(), tmp_path / "report.html")).text
    (run.folder.path / "survey.yaml").unlink()
    uncertainty = text[text.index("Uncertainty") :]
    assert said in uncertainty
    assert not_said not in uncertainty


@pytest.mark.usefixtures("certain")
def test_the_inspectors_words_are_printed_as_they_are(run: Run, tmp_path: Path):
    words = "dry since 12.03.2026"
    survey = run.folder.path / "survey.yaml"
    survey.write_text(f"standard: EN 13187\nprecipitation: {words}\nwind_m_s: 2.25\n", "utf-8")
    text = Page(write_report(run, run.load_scene(), tmp_path / "report.html", language="de")).text
    survey.unlink()
    assert text.count(words) == 2
    assert text.count("2,25 m/s") == 2


@pytest.mark.usefixtures("certain")
def test_what_was_not_searched_for_is_not_said_to_be_missing(run: Run, tmp_path: Path):
    marks, camera = open_marks(run), run.load_scene().train[0].images[THERMAL].camera
    marks.spot(camera, (20, 15))
    survey = run.folder.path / "survey.yaml"
    survey.write_text("hot_places: 0\ncold_places: 0\n", encoding="utf-8")
    text = Page(write_report(run, run.load_scene(), tmp_path / "report.html")).text
    survey.write_text("hot_places: 0\n", encoding="utf-8")
    half = Page(write_report(run, run.load_scene(), tmp_path / "report.html")).text
    survey.unlink()
    for what in ("Hot", "Cold"):
        assert f"{what} places were not searched for, as survey.yaml asks." in text
    assert "stands out" not in text
    assert "Hot places were not searched for" in half
    assert "Cold places were not" not in half


def test_a_mark_without_temperature_keeps_its_note(run: Run, tmp_path: Path):
    marks, camera = open_marks(run), run.load_scene().train[0].images[THERMAL].camera
    marks.box(camera, (16, 12), (24, 18), emissivity=0.8, note="brass")
    page = write_report(run, run.load_scene(), tmp_path / "report.html")
    html = page.read_text(encoding="utf-8")
    assert "the photos do not say the reflected temperature; give it too\nbrass</td>" in html
    assert "Corrected for" not in html


def test_what_too_few_photos_see_is_no_proposal(run: Run, monkeypatch: pytest.MonkeyPatch):
    marks, scene = open_marks(run), run.load_scene()
    marks.meter.uncertainty = Doubting(0.0)
    regions = marks.meter.regions(marks.marks)
    assert propose(marks, scene, regions, Survey()).anomalies
    monkeypatch.setattr(MarkMeter, "_photos_of", lambda meter, places: 1)
    found = propose(marks, scene, regions, Survey())
    assert (found.anomalies, found.held_back) == ({}, 0)
