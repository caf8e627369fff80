"""What ``mrgs report`` keeps of a survey."""

from __future__ import annotations

import pytest

from mrgs.app.cli import _state_survey
from mrgs.app.commands import Report
from mrgs.errors import ConfigError
from mrgs.survey import Survey, read_survey


def test_the_first_report_leaves_a_survey_to_fill_in(tmp_path, capsys):
    _state_survey(Report(tmp_path))
    assert "survey: fill in" in capsys.readouterr().out
    assert read_survey(tmp_path / "survey.yaml") == Survey()
    _state_survey(Report(tmp_path))
    assert capsys.readouterr().out == ""


def test_what_is_stated_once_is_kept(tmp_path):
    given = tmp_path / "given.yaml"
    given.write_text("client: Town\ninside_c: 20\n", encoding="utf-8")
    run = tmp_path / "run"
    _state_survey(Report(run, survey=given, set=("inside_c=21.5",)))
    _state_survey(Report(run, set=("object=School",)))
    stated = read_survey(run / "survey.yaml")
    assert stated == Survey(client="Town", object="School", inside_c=21.5)


def test_a_survey_that_is_not_there(tmp_path):
    with pytest.raises(ConfigError, match=r"--survey .*none\.yaml"):
        _state_survey(Report(tmp_path, survey=tmp_path / "none.yaml"))
