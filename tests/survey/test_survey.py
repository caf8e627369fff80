from __future__ import annotations

import datetime
from dataclasses import fields, replace

import pytest

from mrgs.errors import ConfigError, RunError
from mrgs.survey import Survey, keep_crop, read_survey, write_survey

STATED = Survey(
    title="Cold bridges",
    object="School: gym\nand hall",
    standard="EN 13187",
    date=datetime.date(2026, 1, 12),
    time="06:30",
    inside_c=21.0,
    wind_m_s=0.0,
    crop=(-4.0, -3.0, 0.0, 4.0, 3.0, 6.5),
    crop_outlines=(((0.0, 0.0), (3.0, 0.25), (2.0, 2.5)), ((-1.0, 0.0), (3.0, 0.0), (3.0, 2.0))),
)


def test_what_is_written_is_read_back(tmp_path):
    path = write_survey(tmp_path / "survey.yaml", STATED)
    assert read_survey(path) == STATED


def test_the_template_names_every_field_and_is_an_empty_survey(tmp_path):
    path = write_survey(tmp_path / "survey.yaml", Survey())
    lines = path.read_text(encoding="utf-8").splitlines()
    assert {f"{field.name}:" for field in fields(Survey)} <= set(lines)
    assert read_survey(path) == Survey() == read_survey(tmp_path / "none.yaml")
    assert not Survey()


def test_an_empty_file_states_nothing(tmp_path):
    path = tmp_path / "survey.yaml"
    path.write_text("# nothing yet\n", encoding="utf-8")
    assert read_survey(path) == Survey()


def test_assignments_change_some_fields():
    changed = STATED.stating(
        ["client=Town: of X", "inside_c=19", "date=2026-02-01", "title="], "--set"
    )
    assert changed == replace(
        STATED,
        client="Town: of X",
        inside_c=19.0,
        date=datetime.date(2026, 2, 1),
        title=None,
    )


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("client", "NAME=VALUE, .*title, object"),
        ("nobody=1", "NAME=VALUE, .*title, object"),
        ("inside_c=warm", "inside_c .*'warm'"),
        ("wind_m_s=-3", "wind_m_s .*m/s, .*-3"),
        ("hot_places=101", "hot_places .*101"),
        ("cold_places=1.5", r"cold_places .*1\.5"),
        ("standard=my own", "standard .*EN 13187"),
        ("date=tomorrow", "date .*'tomorrow'"),
        ("date=2026-05-01 10:00", "date .*'2026-05-01 10:00'"),
        ("date=2026-05-01 10:00:00", "date .*'2026-05-01 10:00:00'"),
        ("date=01.05.2026", r"date .*'01\.05\.2026'"),
        ("date=2026", "date .*2026"),
        ("crop=[1, 2, 3]", "crop .*6 values"),
        ("crop=[0, 0, 0, 1, 1, warm]", "crop .*'warm'"),
        ("crop=[0, 0, 0, 1, 1, 0]", "crop .*corners"),
        (
            "crop_outlines=[[0, 0], [4, 0], [4, 3]]",
            "crop_outlines .*list of 2 values, not 0",
        ),
        ("crop_outlines=[[[0, 0], [4, 0], [4]]]", "crop_outlines must be a list of 2 values"),
        ("crop_outlines=[[[0, 0], [4, .inf], [4, 1]]]", "crop_outlines must be a finite number"),
        ("crop_outlines={x: 1}", "crop_outlines must be a list, not"),
        ("remarks=" + "x" * 2001, "remarks .*2,000"),
    ],
)
def test_what_cannot_be_stated(assignment, message):
    with pytest.raises(ConfigError, match=message):
        Survey().stating([assignment], "--set")


@pytest.mark.parametrize("text", ["2026-05-01", "'2026-05-01'", '"2026-05-01"'])
def test_a_date_with_and_without_quotes(tmp_path, text):
    path = tmp_path / "survey.yaml"
    path.write_text(f"date: {text}\n", encoding="utf-8")
    assert read_survey(path) == Survey(date=datetime.date(2026, 5, 1))
    assert type(read_survey(path).date) is datetime.date


def test_a_time_that_yaml_takes_for_a_number(tmp_path):
    path = tmp_path / "survey.yaml"
    path.write_text("time: 10:30\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"time .*630; .*quotes"):
        read_survey(path)


def test_a_file_that_is_no_survey(tmp_path):
    path = tmp_path / "survey.yaml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RunError, match="cannot be read"):
        read_survey(path)
    path.write_text("x" * 100_001, encoding="utf-8")
    with pytest.raises(ConfigError, match="100,000"):
        read_survey(path)
    path.write_text("weather: sun\nclouds: 3\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"'clouds'; .*title, object"):
        read_survey(path)


BOXES = [(-float(i), -1.0, -1.0, 1.0, 1.0, 1.0) for i in range(1, 60)]


def test_what_is_kept_is_undone_step_by_step_and_nothing_else_changes(tmp_path):
    file = write_survey(tmp_path / "survey.yaml", STATED)
    states = [(BOXES[0], None), (None, STATED.crop_outlines), (None, None)]
    for state in states:
        keep_crop(tmp_path, state)
        assert read_survey(file) == replace(STATED, crop=state[0], crop_outlines=state[1])
    keep_crop(tmp_path, states[-1])  # the same again is no step
    for state in (*states[-2::-1], STATED.kept):
        keep_crop(tmp_path, None)
        assert read_survey(file).kept == state
    assert read_survey(file) == STATED
    with pytest.raises(ConfigError, match="nothing to undo"):
        keep_crop(tmp_path, None)


def test_the_last_fifty_steps_can_be_undone(tmp_path):
    for box in BOXES:
        keep_crop(tmp_path, (box, None))
    for _ in range(50):
        keep_crop(tmp_path, None)
    assert read_survey(tmp_path / "survey.yaml").crop == BOXES[-51]
    with pytest.raises(ConfigError, match="nothing to undo"):
        keep_crop(tmp_path, None)


@pytest.mark.parametrize(
    "text", ["[[1", "{}", "[[[1, 2], null]]", "[" * 5000, '[[null, [[["a", 1]]]]]']
)
def test_a_damaged_file_for_undoing_undoes_nothing(tmp_path, text):
    (tmp_path / "crop.undo.json").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match="nothing to undo"):
        keep_crop(tmp_path, None)
    keep_crop(tmp_path, (BOXES[0], None))
    keep_crop(tmp_path, None)
    assert read_survey(tmp_path / "survey.yaml").kept == (None, None)


def test_a_broken_survey_and_a_missing_folder_are_left_as_they_are(tmp_path):
    file = tmp_path / "survey.yaml"
    file.write_text("crop: all\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"survey.yaml: crop"):
        keep_crop(tmp_path, (BOXES[0], None))
    assert file.read_text(encoding="utf-8") == "crop: all\n"
    with pytest.raises(RunError, match="is gone"):
        keep_crop(tmp_path / "none", (BOXES[0], None))
    assert not (tmp_path / "none").exists()
