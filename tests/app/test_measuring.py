"""``mrgs measure`` from end to end."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from mrgs import open_marks
from mrgs.app.cli import main
from mrgs.marks.mark import Mark
from mrgs.runs.open import load_run
from mrgs.scene import THERMAL, Box
from mrgs.survey import Survey, read_survey, write_survey
from tests.helpers.runs import SMALL, trained_run

VIEW = "frame_train_00001"


@pytest.fixture(scope="module")
def folder(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("measured") / "run"
    return trained_run(tmp_path_factory, small_scene, SMALL, output)


@pytest.fixture
def run(folder: Path) -> Path:
    for path in folder.glob("*marks*"):
        path.unlink()
    return folder


def lines(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return capsys.readouterr().out.splitlines()


def test_marks_are_added_listed_exported_and_undone(run, tmp_path, capsys):
    assert main(["measure", str(run)]) == 0
    (hint,) = lines(capsys)
    assert "--spot VIEW:X,Y" in hint
    assert main(["measure", str(run), "--spot", f"{VIEW}:20,15", "--note", "warm"]) == 0
    add_box = ["--box", f"{VIEW}:17,12", "23,18", "--name", "Middle", "--reference", "S1"]
    targets = ["--csv", str(tmp_path / "m.csv"), "--geojson", str(tmp_path / "m.geojson")]
    assert main(["measure", str(run), *add_box, *targets]) == 0
    heading, spot, box, *files = lines(capsys)[-5:]
    assert heading.split()[:4] == ["Mark", "Kind", "Mean,", "°C"]
    assert spot.split()[:2] == ["S1", "spot"]
    assert spot.endswith("warm")
    assert box.split()[:2] == ["Middle", "box"]
    assert [line.partition(":")[0] for line in files] == ["csv", "geojson"]
    assert all(Path(each).is_file() for each in targets[1::2])
    assert (
        main(["measure", str(run), "--mark", "Middle", "--name", "Core", "--emissivity", ".8"]) == 0
    )
    assert main(["measure", str(run), "--delete", "S1"]) == 0
    assert lines(capsys)[-1].split()[0] == "Core"
    assert main(["measure", str(run), "--undo"]) == 0
    assert [line.split()[0] for line in lines(capsys)[-2:]] == ["S1", "Core"]
    assert load_run(run).folder.path == run


def test_what_is_assumed_is_said_and_exported(run, tmp_path, capsys):
    table, map_file = tmp_path / "m.csv", tmp_path / "m.geojson"
    assert main(["measure", str(run), "--spot", f"{VIEW}:20,15", "--csv", str(table)]) == 0
    camera = "The accuracy of the thermal camera is not known, and not included."
    assert f"mrgs: note: {camera}" in capsys.readouterr().err
    assert rows(table)[0]["remarks"].endswith(camera)
    corrected = ["--box", f"{VIEW}:17,12", "23,18", "--emissivity", ".8", "--reflected", "15"]
    targets = ["--csv", str(table), "--geojson", str(map_file)]
    assert main(["measure", str(run), *corrected, *targets]) == 0
    said = capsys.readouterr().err
    notes = open_marks(load_run(run)).meter.capture.notes
    assert notes, "the photos say nothing of emissivity"
    for note in notes:
        assert f"mrgs: note: {note}" in said
        assert str(note) in rows(table)[1]["remarks"]
        assert str(note) in json.loads(map_file.read_text())["features"][1]["properties"]["remarks"]
    assert said.count(camera) == 1, "once for all marks"


def rows(table: Path) -> list[dict[str, str]]:
    with table.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_the_help_says_how_many_places_each_kind_takes(capsys):
    with pytest.raises(SystemExit):
        main(["measure", "--help"])
    help = capsys.readouterr().out
    for option in (
        "--spot VIEW:X,Y ",
        "--line VIEW:X,Y X,Y [X,Y ...]",
        "--box VIEW:X,Y X,Y ",
        "--polygon VIEW:X,Y X,Y X,Y [X,Y ...]",
        "--accept NAME [NAME ...]",
    ):
        assert option in help


def test_proposals_are_listed_accepted_and_dropped(run, capsys):
    assert main(["measure", str(run), "--spot", f"{VIEW}:20,15"]) == 0
    marks = open_marks(load_run(run))
    found = [replace(marks.marks.marks[0], name=name) for name in ("H1", "C1")]
    marks.store.edit(lambda known: replace(known, proposals=tuple(found)))
    capsys.readouterr()
    assert main(["measure", str(run)]) == 0
    *_, heading, hot, cold, hint = lines(capsys)
    assert [line.split()[0] for line in (heading, hot, cold)] == ["Proposed", "H1", "C1"]
    assert "--accept H1" in hint
    assert "--drop H1" in hint
    judged = ["--accept", "H1", "--severity", "2", "--note", "leak", "--drop", "C1"]
    assert main(["measure", str(run), *judged]) == 0
    assert lines(capsys)[-1].split()[0] == "H1"
    known = marks.marks
    assert (known.named("H1").severity, known.named("H1").note) == ("2", "leak")
    assert [mark.name for mark in known.dropped] == ["C1"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--spot", f"{VIEW}:1,2", "--box", f"{VIEW}:1,2", "3,4"], "one mark"),
        (["--spot", f"{VIEW}:1,2", f"{VIEW}:3,4"], "one place, VIEW:X,Y"),
        (["--spot", f"{VIEW}:1,2", "--mark", "S1"], "--mark changes"),
        (["--note", "damp"], "with --mark"),
        (["--box", f"{VIEW}:1,2"], "VIEW:X,Y X,Y"),
        (["--line", "5,6", "7,8"], "--line 5,6 7,8: "),
        (["--spot", f"{VIEW}:1.2.3,5"], f"--spot {VIEW}:1.2.3,5: "),
        (["--spot", "nowhere:1,2"], f"'nowhere'; the first is {VIEW[:11]}"),
        (["--spot", f"{VIEW}:99,2"], "outside the image"),
        (["--mark", "S1", "--note", "damp"], "no mark 'S1'"),
        (["--accept", "H1"], "no proposal 'H1'"),
        (["--drop", "C1"], "no proposal 'C1'"),
        (["--accept", "H1", "--spot", f"{VIEW}:1,2"], "either --accept or"),
        (["--undo"], "nothing to undo"),
    ],
)
def test_what_cannot_be_done_is_one_line(run, options, message, capsys):
    assert main(["measure", str(run), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not (run / "marks.json").exists()


def test_a_reference_temperature_shifts_the_whole_run(run, tmp_path):
    run = shutil.copytree(run, tmp_path / "run")
    assert main(["measure", str(run), "--spot", f"{VIEW}:20,15"]) == 0
    before = load_run(run)
    (reading,) = open_marks(before).measure()
    view = next(view for view in before.load_scene().train if view.name == VIEW)
    recorded = before.camera_response(before.render_view(view), view.camera)[THERMAL].image
    true = reading.mean + 5.0
    assert main(["measure", str(run), "--reference", f"S1={true:.3f}"]) == 0
    after = load_run(run)
    assert open_marks(after).measure()[0].mean == pytest.approx(true, abs=0.3)
    assert open_marks(after).marks.reference == "S1"
    shift = after.render_view(view)[THERMAL].image - before.render_view(view)[THERMAL].image
    span_c, row, column = before.temperature.span_c, 15, 20
    assert shift[row, column].item() * span_c == pytest.approx(5.0, abs=0.3)
    again = after.camera_response(after.render_view(view), view.camera)[THERMAL].image
    difference_c = (again - recorded)[row, column].item() * span_c
    assert abs(difference_c) < 0.75, "all but what shows through a model of 60 steps"


@pytest.mark.parametrize(
    ("reference", "words"),
    [("S1=warm", "MARK=°C"), ("S9=12.4", "S9"), ("Far=12.4", "cannot be a reference")],
)
def test_a_reference_temperature_that_cannot_be_is_refused(run, capsys, reference, words):
    marks = open_marks(load_run(run))
    far = Mark("Far", "spot", ((50.0, 50.0, 50.0),), (51.0, 50.0, 50.0), 0.1)
    marks.store.edit(lambda known: known.adding(**vars(far)))
    assert main(["measure", str(run), "--reference", reference]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line


def test_what_is_cropped_is_not_measured(run, capsys):
    assert main(["measure", str(run), "--spot", f"{VIEW}:20,15"]) == 0
    means = load_run(run).model.gaussians.means
    x, y, z = means[means[:, 2].argmin()].tolist()
    write_survey(run / "survey.yaml", Survey(crop=(x - 0.1, y - 0.1, z - 0.1, x + 0.1, y + 0.1, z)))
    capsys.readouterr()
    assert main(["measure", str(run)]) == 0
    printed = capsys.readouterr()
    assert "–" in printed.out.splitlines()[1].split()[2]
    assert "left out" in printed.err
    (run / "survey.yaml").unlink()


@pytest.mark.parametrize("command", ["render", "export", "view"])
def test_a_box_beside_the_model_is_refused_before_anything_is_made(run, command, capsys):
    assert main([command, str(run), "--crop", "-9", "9", "9", "-8", "8.5", "8"]) == 2
    assert "crop: no Gaussian is in the box -9 8.5 8 to -8 9 9" in capsys.readouterr().err


def test_a_box_beside_the_model_is_refused_before_it_is_in_the_survey(run, capsys):
    survey = run / "survey.yaml"
    write_survey(survey, Survey(client="Town"))
    assert main(["report", str(run), "--set", "crop=[90, 90, 90, 91, 91, 91]"]) == 2
    assert read_survey(survey) == Survey(client="Town")
    write_survey(survey, Survey(crop=(90, 90, 90, 91, 91, 91)))
    capsys.readouterr()
    assert main(["report", str(run), "--set", "client=City"]) == 2
    assert f"{survey}: crop" in capsys.readouterr().err
    survey.unlink()


def test_a_rendering_shows_what_is_in_the_box(run, capsys):
    means = load_run(run).model.gaussians.means
    low, high = means.amin(dim=0).tolist(), means.median(dim=0).values.tolist()
    assert main(["render", str(run), "--crop", *map(str, [*low, *high])]) == 0
    said = capsys.readouterr().err
    inside = int((means <= means.median(dim=0).values).all(dim=1).sum())
    assert f"{len(means) - inside:,} Gaussians are left out" in said


@pytest.mark.parametrize(("other", "word"), [("run", "twice"), ("nothing", "not a run")])
def test_two_dates_are_two_runs(run, tmp_path, capsys, other, word):
    second = run if other == "run" else tmp_path
    assert main(["diff", str(run), str(second)]) == 2
    assert word in capsys.readouterr().err


def test_two_dates_are_listed_and_written(run, tmp_path, capsys, monkeypatch):
    def compared(first, second, *, relative, least_k):
        page = tmp_path / "diff.html"
        page.write_text("page")
        row = ["D1", "new", "1.0", "3.0", "+2.0", "0.3", "0.1 m²", "1, 2, 3", ""]
        return SimpleNamespace(
            common=1.25,
            relative=relative,
            rows=lambda: ([row], []),
            write=lambda folder, language, pdf: [page],
        )

    monkeypatch.setattr("mrgs.report.changes.diff_runs", compared)
    given = ["--relative", "--output", str(tmp_path)]
    assert main(["diff", str(run), str(shutil.copytree(run, tmp_path / "b")), *given]) == 0
    heading, change, summary, _, opened = lines(capsys)
    assert heading.split()[0] == "Place"
    assert change.split()[:2] == ["D1", "new"]
    assert "1 change; common change +1.25 K" in summary
    assert "diff.html" in opened


@pytest.mark.parametrize(("size", "word"), [("1.05", "1.05x1.75"), ("1x0.1", "sides are")])
def test_modules_have_a_size(run, capsys, size, word):
    assert main(["modules", str(run), "--module", size]) == 2
    assert word in capsys.readouterr().err
    assert not (run / "modules").exists()


def test_modules_are_listed_and_written(run, tmp_path, capsys, monkeypatch):
    page = tmp_path / "modules.html"
    page.write_text("page")
    asked = []

    def listed(opened, size_m, power_w, yield_kwh):
        asked.append((size_m, power_w, yield_kwh))
        found = {"rows": [{}] * 3, "findings": [1]}
        return SimpleNamespace(**found, write=lambda folder, language, pdf: [page])

    monkeypatch.setattr("mrgs.report.modules.module_table", listed)
    given = [
        "--module",
        "1.05x1.75",
        "--power",
        "400",
        "--yield-kwh",
        "950",
        "--output",
        str(tmp_path),
    ]
    assert main(["modules", str(run), *given]) == 0
    assert asked == [((1.05, 1.75), 400.0, 950.0)]
    said = capsys.readouterr().out
    assert "3 modules, 1 with findings" in said
    assert "modules.html" in said


def test_everything_follows_what_the_survey_keeps(run, tmp_path, capsys):
    whole = load_run(run)
    outline = ((-9.0, -9.0), (0.0, -9.0), (0.0, 9.0), (-9.0, 9.0))
    whole.keep(Box.around([outline], -9.0, 9.0))
    inside = int((whole.model.gaussians.means[:, 0] < 0).sum())
    for command in (
        ["export", str(run), "--format", "ply"],
        ["report", str(run)],
        ["render", str(run)],
    ):
        capsys.readouterr()
        assert main([*command]) == 0
        said = capsys.readouterr().err
        assert f"{whole.gaussian_count - inside:,} Gaussians are left out" in said
        assert "within an outline of 4 corners" in said
    facts = json.loads((run / "export/rgb.ply.json").read_text(encoding="utf-8"))
    assert facts["splats"] == inside
    assert facts["crop"]["outlines"] == [[list(corner) for corner in outline]]
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "within an outline of 4 corners is shown" in page
    assert main(["report", str(run), "--set", "crop=", "crop_outlines="]) == 0
    assert "left out" not in capsys.readouterr().err
    assert read_survey(run / "survey.yaml").kept == (None, None)
    text = f"crop_outlines=[{[list(corner) for corner in outline]}]"
    assert main(["report", str(run), "--set", text, "--output", str(tmp_path / "r.html")]) == 0
    assert f"{whole.gaussian_count - inside:,} Gaussians are left out" in capsys.readouterr().err
    (run / "survey.yaml").unlink()
