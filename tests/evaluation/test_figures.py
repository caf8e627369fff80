from __future__ import annotations

import math

import pytest

from mrgs.evaluation.metrics import Missing, mean_figure, to_json


def test_the_mean_leaves_out_what_is_missing() -> None:
    assert mean_figure([1.0, Missing("no mask"), 3.0]) == 2.0


def test_the_mean_of_nothing_is_missing_with_the_first_reason() -> None:
    assert mean_figure([Missing("first"), Missing("second")]) == Missing("first")
    assert isinstance(mean_figure([]), Missing)


def test_an_infinite_figure_is_not_dropped_from_the_mean() -> None:
    assert mean_figure([30.0, math.inf]) == math.inf
    assert math.isnan(mean_figure([30.0, math.nan]))


@pytest.mark.parametrize(
    ("figure", "keyword"),
    [
        (Missing("why"), "why"),
        (math.inf, "identical"),
        (-math.inf, "overflows"),
        (math.nan, "NaN"),
    ],
)
def test_what_json_cannot_hold_becomes_a_reason(figure: float | Missing, keyword: str) -> None:
    number, reason = to_json(figure)
    assert number is None
    assert keyword in reason


def test_a_number_stays() -> None:
    assert to_json(1.5) == (1.5, None)
