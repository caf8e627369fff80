"""What ``mrgs report`` keeps of a survey."""

from __future__ import annotations

import sys

import pytest
from PIL import Image

from mrgs.app.cli import _keep_survey, _stated_survey, main
from mrgs.app.commands import Report
from mrgs.errors import ConfigError
from mrgs.survey import Survey, read_survey


def state(command: Report) -> None:
    _keep_survey(command.run, _stated_survey(command))


def test_the_first_report_leaves_a_survey_to_fill_in(tmp_path, capsys):
    state(Report(tmp_path))
    assert "survey: fill in" in capsys.readouterr().out
    assert read_survey(tmp_path / "survey.yaml") == Survey()
    state(Report(tmp_path))
    assert capsys.readouterr().out == ""


def test_what_is_stated_once_is_kept(tmp_path):
    given = tmp_path / "given.yaml"
    given.write_text("client: Town\ninside_c: 20\n", encoding="utf-8")
    run = tmp_path / "run"
    state(Report(run, survey=given, set=("inside_c=21.5",)))
    state(Report(run, set=("object=School",)))
    stated = read_survey(run / "survey.yaml")
    assert stated == Survey(client="Town", object="School", inside_c=21.5)


def test_a_logo_is_beside_the_file_or_the_user_who_states_it(tmp_path, monkeypatch):
    given, run, here = tmp_path / "given", tmp_path / "run", tmp_path / "here"
    for folder in (given, run, here):
        folder.mkdir()
        Image.new("RGB", (8, 8)).save(folder / f"{folder.name}.png")
    monkeypatch.chdir(here)
    (given / "survey.yaml").write_text("logo: given.png\n", encoding="utf-8")
    state(Report(run, survey=given / "survey.yaml"))
    assert read_survey(run / "survey.yaml").logo == str(given / "given.png")
    state(Report(run, set=("logo=here.png",)))
    assert read_survey(run / "survey.yaml").logo == str(here / "here.png")
    with pytest.raises(ConfigError, match=r"missing\.png"):
        state(Report(run, set=("logo=missing.png",)))
    assert read_survey(run / "survey.yaml").logo == str(here / "here.png"), "as it was"


def test_a_survey_that_is_not_there(tmp_path):
    with pytest.raises(ConfigError, match=r"--survey .*none\.yaml"):
        state(Report(tmp_path, survey=tmp_path / "none.yaml"))


@pytest.mark.parametrize(("option", "package"), [("--pdf", "weasyprint"), ("--docx", "docx")])
def test_a_missing_package_is_told_before_anything_else(
    tmp_path, monkeypatch, capsys, option, package
):
    monkeypatch.setitem(sys.modules, package, None)
    assert main(["report", str(tmp_path), option, "--set", "client=Town"]) == 2
    assert "mrgs[report]" in capsys.readouterr().err, "and not that this folder is no run"
    assert [*tmp_path.iterdir()] == []
