"""How the work runs a stage."""

from __future__ import annotations

from pathlib import Path

import pytest

from mrgs.errors import RunError, SceneError
from mrgs.prepare.contract import StageSummary
from mrgs.prepare.stages import page_on_error
from mrgs.prepare.work import Work


def first_stage(work: Work) -> StageSummary:
    work.progress("looking", 1, 2)
    found = work.cache.get("first", str, (), lambda: "found")
    return StageSummary((found,), ("Careful.",))


def test_a_stage_is_done_once_and_reported_twice(tmp_path):
    steps, reports = [], []
    for _ in range(2):
        work = Work(
            tmp_path, tmp_path, on_progress=lambda *s: steps.append(s), on_report=reports.append
        )
        work.run("first stage", first_stage)
        assert work.reports == reports[-1:]
    assert steps[:2] == steps[2:]
    assert [(step.partition(":")[2], *numbers) for step, *numbers in steps[:2]] == [
        ("", 0, 0),
        (" looking", 1, 2),
    ]
    assert [report.reused for report in reports] == [False, True]
    assert reports[0].seconds > 0 == reports[1].seconds
    assert {(report.title, report.lines, report.warnings) for report in reports} == {
        ("first stage", ("found",), ("Careful.",))
    }


def test_the_page_that_shows_an_error_is_named(tmp_path):
    def page(work: Work, failed: object) -> Path:
        return Path("page.html")

    with (
        pytest.raises(SceneError, match=r"no overlap; page\.html shows what was found so far"),
        page_on_error(Work(tmp_path, tmp_path), page),
    ):
        raise SceneError("no overlap")


@pytest.mark.parametrize("error", [RunError("the disk is full"), SceneError("a photo is gone")])
def test_an_error_is_told_though_no_page_can_show_it(error, tmp_path):
    def page(work: Work, failed: object) -> Path:
        raise error

    with (
        pytest.raises(SceneError, match=r"^no overlap$"),
        page_on_error(Work(tmp_path, tmp_path), page),
    ):
        raise SceneError("no overlap")
