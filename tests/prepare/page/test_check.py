"""A scene on disk, checked."""

from __future__ import annotations

import html
import json
import re

import pytest

from mrgs.check import Problem
from mrgs.check.problem import worst_first
from mrgs.errors import RunError, SceneError
from mrgs.prepare.page.check import check_scene


def texts(check) -> str:
    return " | ".join(f"{problem.severity}: {problem.text}" for problem in check.problems)


def test_a_usable_scene_is_described_and_drawn(make_scene):
    folder = make_scene()
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    steps: list[tuple[str, int, int]] = []
    check = check_scene(folder, lambda *step: steps.append(step))
    assert check.usable
    described = " | ".join(check.lines)
    for fact in ("6 training", "2 held out", "8 thermal images", "40×30 px", "10 to 30 °C"):
        assert fact in described
    (problem,) = (one for one in check.problems if "6 training" in one.text)
    assert problem.severity == "warning"
    assert check.page == folder / "check.html"
    page = check.page.read_text(encoding="utf-8")
    for words in (
        "Scene check: scene",
        html.escape(problem.text),
        "40×30 px",
        "frame_eval_00002",
        "From above",
    ):
        assert words in page
    assert steps[-1] == ("reading images", 8, 8)
    assert all(path.read_bytes() == content for path, content in before.items())


def test_a_scale_and_north_that_are_known_are_shown(make_scene):
    folder = make_scene()
    unknown = check_scene(folder)
    assert '"metric": false' in unknown.page.read_text(encoding="utf-8")
    assert any(line.endswith(" scene units.") for line in unknown.lines)
    file = folder / "transforms.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    content["georeference"] = {"units": "metres", "axes": "east north up"}
    file.write_text(json.dumps(content), encoding="utf-8")
    check = check_scene(folder)
    page = check.page.read_text(encoding="utf-8")
    assert '"metric": true' in page
    assert "north is up" in page
    assert "direction is estimated" not in page
    assert any(line.endswith(" m.") for line in check.lines)


def test_the_settings_of_the_temperatures_are_shown(make_scene):
    folder = make_scene()
    assert "Emissivity" not in check_scene(folder).page.read_text(encoding="utf-8")
    file = folder / "transforms.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    for frame in content["frames"]:
        frame["thermal_record"] = {"source": "DJI R-JPEG", "given": {"emissivity": 0.7}}
    file.write_text(json.dumps(content), encoding="utf-8")
    assert re.search(r"\b0\.70\b.*given", check_scene(folder).page.read_text(encoding="utf-8"))


def test_the_file_may_be_named_too(make_scene):
    folder = make_scene(rgb=False)
    assert check_scene(folder / "transforms.json").page == folder / "check.html"


def test_what_the_reader_refuses_is_an_error_on_a_page(make_scene):
    folder = make_scene()
    (folder / "transforms.json").write_text('{"frames": [<script>]}')
    check = check_scene(folder)
    assert not check.usable
    assert "valid JSON" in texts(check)
    assert "1 error" in check.page.read_text(encoding="utf-8")


def test_what_the_reader_corrects_is_a_warning(make_scene):
    folder = make_scene()
    bounds = {"absolute_min_temperature": 30.0, "absolute_max_temperature": 10.0}
    (folder / "temperature_bounds.json").write_text(json.dumps(bounds))
    assert "warning: temperature_bounds.json" in texts(check_scene(folder))


def test_an_image_that_is_cut_off_is_an_error_and_the_page_shows_the_others(make_scene):
    folder = make_scene()
    image = folder / "images" / "frame_train_00003.png"
    image.write_bytes(image.read_bytes()[:-200])
    check = check_scene(folder)
    assert not check.usable
    assert check.problems[0].severity == "error"
    assert "frame_train_00003.png" in check.problems[0].text
    assert "frame_train_00003" in check.page.read_text(encoding="utf-8")


def test_file_names_are_no_markup(make_scene):
    folder = make_scene()
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        for key in ("file_path", "thermal_file_path"):
            path = folder / frame[key]
            hostile = path.with_name(path.name.replace("frame", "<b onclick=alert(1)>&amp;'"))
            path.rename(hostile)
            frame[key] = hostile.relative_to(folder).as_posix()
    (folder / "transforms.json").write_text(json.dumps(content))
    page = check_scene(folder).page.read_text(encoding="utf-8")
    assert "&lt;b onclick=alert(1)&gt;" in page
    assert "<b onclick" not in page


@pytest.mark.parametrize("name", ["nowhere", "notes.txt"])
def test_what_is_no_folder_is_told(tmp_path, name):
    (tmp_path / "notes.txt").write_text("no scene")
    with pytest.raises(SceneError, match=f"{name}: not a folder"):
        check_scene(tmp_path / name)


def test_nothing_is_written_into_a_folder_without_a_scene(tmp_path):
    (tmp_path / "notes.txt").write_text("no scene")
    with pytest.raises(SceneError, match="no scene found"):
        check_scene(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_several_camera_files_are_an_error_on_a_page(tmp_path):
    for name in ("transforms_a.json", "transforms_b.json"):
        (tmp_path / name).write_text("{}")
    check = check_scene(tmp_path)
    assert "error" in texts(check)
    assert "several transforms" in check.page.read_text(encoding="utf-8")


def test_a_folder_that_cannot_be_written_is_told(make_scene):
    folder = make_scene()
    (folder / "check.html").mkdir()
    with pytest.raises(RunError, match=r"check\.html"):
        check_scene(folder)


def test_the_worst_comes_first():
    problems = [
        Problem("note", "a"),
        Problem("error", "b"),
        Problem("warning", "c"),
        Problem("error", "d"),
    ]
    assert [problem.text for problem in worst_first(problems)] == ["b", "d", "c", "a"]
