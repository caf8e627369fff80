from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.plan import Effort
from benchmarks.timing import Summary, Timing, measure


@settings(max_examples=30)
@given(st.lists(st.floats(0.001, 1e4), min_size=1, max_size=40))
def test_a_summary_holds_median_quartiles_and_least(samples):
    summary = Summary.of(samples)
    expected = np.percentile(samples, [50, 25, 75, 0])
    found = (summary.median_ms, summary.q1_ms, summary.q3_ms, summary.min_ms)
    assert found == pytest.approx(expected, rel=1e-9)
    assert summary.runs == len(samples)


def test_stages_run_in_turns_each_after_its_setup():
    calls = []
    timings = [
        Timing(
            name,
            lambda argument: calls.append(argument),
            lambda name=name: calls.append(f"setup {name}") or name,
        )
        for name in "ab"
    ]
    summaries = measure(timings, Effort(runs=2, seconds=60.0, fewest=1, warm_up=1))
    assert calls == ["setup a", "a", "setup b", "b"] * 3
    assert {name: summary.runs for name, summary in summaries.items()} == {"a": 2, "b": 2}


def test_a_slow_case_is_run_less_often_but_never_too_seldom():
    effort = Effort(runs=100, seconds=0.0, fewest=4, warm_up=0)
    assert measure([Timing("a", lambda _: None)], effort)["a"].runs == 4


def test_setup_is_not_timed():
    def slow_setup() -> int:
        return sum(range(1_000_000))

    summary = measure([Timing("a", lambda _: None, slow_setup)], Effort(runs=5, warm_up=0))["a"]
    assert summary.min_ms < 1.0
