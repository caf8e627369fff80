"""How the work runs a stage."""

from __future__ import annotations

from mrgs.prepare.contract import StageSummary
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
