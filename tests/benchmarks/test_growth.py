from __future__ import annotations

import pytest

from benchmarks.growth.__main__ import measure
from benchmarks.growth.plan import GROUPS, Case, case_from_json, case_to_json
from benchmarks.growth.report import Row, exponents, most, to_markdown
from tests.benchmarks.tables import rows as cells_of

MACHINE = {"processor": "some", "python": "3", "torch": "2", "numba": "0", "threads": 1}
WITHIN = 0.2


def row(gaussians: int, step_s: float, peak_gb: float, axis: str = "gaussians") -> Row:
    return Row(Case(axis, gaussians), 2.0, step_s, round(peak_gb * 1e9), round(1.1 * peak_gb * 1e9))


def test_the_estimate_is_within_a_fifth_of_what_a_training_takes():
    found = measure(Case("estimate", 100_000, photos=2, size=(160, 120)))
    assert "failed" not in found
    assert found["step_s"] > 0
    assert abs(found["estimated_bytes"] / found["peak_bytes"] - 1) < WITHIN


def test_cases_are_read_back():
    for cases in GROUPS.values():
        assert [case_from_json(case_to_json(case)) for case in cases] == cases
        assert len(set(cases)) == len(cases)


def test_along_an_axis_one_number_grows():
    for axis in ("gaussians", "photos", "pixels", "threads"):
        values = [case.x for case in GROUPS[axis]]
        assert values == sorted(set(values))


def test_a_training_densifies_in_the_middle_and_at_the_end():
    for case in (Case("photos", photos=3), Case("photos", photos=50)):
        config = case.config()
        events = [
            step
            for step in range(1, config.max_steps + 1)
            if config.densification.densifies_at(step)
        ]
        assert events == [config.max_steps // 2, config.max_steps]


def test_exponents_are_those_between_neighbours():
    assert exponents([(1, 1), (10, 10), (100, 1000)]) == pytest.approx([1, 2])


def test_what_fits_lies_on_the_line_through_the_last_two():
    rows = [row(100_000, 1, 5.0), row(1_000_000, 1, 1.0), row(2_000_000, 1, 2.0)]
    assert most(rows, 10) == pytest.approx(9_000_000)


def test_the_report_shows_each_axis_and_the_worst_estimate():
    rows = [row(10_000, 0.1, 1.0), row(100_000, 1.0, 2.0), row(1_000, 0.1, 1.0, "estimate")]
    text = to_markdown(rows, MACHINE)
    assert ["100,000", "1.000", "1.00", "2.0", "2.00", "0.30", "+10%"] in cells_of(text)
    assert "Worst: +10%" in text
    assert "Over pixels" not in text
