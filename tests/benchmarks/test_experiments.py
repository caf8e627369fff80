from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import ttest_rel

from benchmarks import experiments

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/experiments.md"


def test_the_interval_is_that_of_a_paired_t_test():
    rng = np.random.default_rng(0)
    ours, theirs = rng.normal(48, 3, 6), rng.normal(45, 3, 6)
    middle, half = experiments.interval((ours - theirs).tolist())
    exact = ttest_rel(ours, theirs).confidence_interval(0.95)
    assert (middle - half, middle + half) == pytest.approx((exact.low, exact.high))


def test_a_difference_whose_interval_holds_zero_is_not_shown():
    assert experiments.difference_text([1.0, 1.2, 1.4], 1) == "+1.2 ± 0.5"
    assert experiments.difference_text([-1.0, 1.2, 0.1], 1) == "+0.1 ± 2.7 (not shown)"
    assert experiments.difference_text([-1.0, 1.2], 1) == "−1.0, +1.2"


def kept(**changes) -> experiments.Kept:
    """Two methods, two scenes, two seeds, every figure of a run the same."""
    values = {
        ("a", "x"): [1.0, 2.0],
        ("a", "y"): [4.0, 6.0],
        ("b", "x"): [2.0, 3.0],
        ("b", "y"): [5.0, 7.0],
    }
    runs = [
        {
            "scene": scene,
            "method": method,
            "seed": seed,
            "figures": {column.figure: value for column in experiments.COLUMNS["cameras"]},
        }
        for (method, scene), of_seeds in values.items()
        for seed, value in enumerate(of_seeds)
    ]
    return {
        "command": "",
        "commit": "0" * 8,
        "baseline": "a",
        "columns": "cameras",
        "runs": runs,
        **changes,
    }


def test_a_table_pairs_the_scenes_and_spreads_over_the_seeds():
    head, _, first, second, _, note = experiments.table(kept()).splitlines()
    assert head.startswith("| | thermal, matched | to `a` |")
    assert first.startswith("| `a` | 3.25 ± 1.06 dB |  |")
    assert second.startswith("| `b` | 4.25 ± 1.06 dB | +1.00, +1.00 |")
    assert "2 scenes" in note


def test_scenes_count_alike_and_the_numbers_of_trainings_are_said_where_they_differ():
    runs = [run for run in kept()["runs"] if (run["scene"], run["seed"]) != ("y", 1)]
    *_, second, _, note = experiments.table(kept(runs=runs)).splitlines()
    assert second.startswith("| `b` | 3.75 dB | +1.00, +1.00 |")  # of 2 and 3, and of 5
    assert "trainings of each: 1 to 2;" in note


def test_a_method_that_not_all_scenes_have_is_compared_on_its_own():
    runs = [run for run in kept()["runs"] if (run["method"], run["scene"]) != ("b", "y")]
    lines = experiments.table(kept(runs=runs)).splitlines()
    assert lines[3].startswith("| `b`, 1 of them | – | +1.00 |")


def test_a_figure_that_a_scene_lacks_is_a_dash():
    runs = [{**run, "figures": {**run["figures"]}} for run in kept()["runs"]]
    del runs[-1]["figures"]["rgb.psnr_matched"], runs[-2]["figures"]["rgb.psnr_matched"]
    row = experiments.table(kept(runs=runs)).splitlines()[3].split(" | ")
    assert row[3:5] == ["–", "–"]
    assert row[1].startswith("4.25")


def test_ratios_are_geometric_means():
    column = experiments.Column("gaussians_k", "Gaussians", 0, "K", is_ratio=True)
    assert experiments._compared([[2.0]] * 3, [[1.0], [4.0], [2.0]], column) == (
        "100 % (18 to 559, not shown)"
    )
    assert experiments._compared([[1.0], [1.1], [0.9]], [[2.0]] * 3, column) == "50 % (39 to 64)"
    assert experiments._mean_text([[1.0], [4.0]], column) == "2 K"
    assert experiments._compared([[2.0], [2.0]], [[1.0], [4.0]], column) == "200, 50 %"
    assert experiments._compared([[3.0]], [[4.0]], column) == "75 %"


def test_one_constant_is_taken_off_all_views_together():
    rng = np.random.default_rng(0)
    errors = rng.normal(0, 0.1, (2, 40, 50))
    errors[1] += 0.5
    found = experiments._after_a_constant([errors[0] + 7.0, errors[1] + 7.0])
    assert found == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize(
    "path", sorted(experiments.RESULTS.glob("*.json")), ids=lambda path: path.stem
)
def test_the_page_shows_the_results_that_are_kept(path):
    results = json.loads(path.read_text(encoding="utf-8"))
    assert experiments.table(results) in PAGE.read_text(encoding="utf-8")
    assert results["command"] in PAGE.read_text(encoding="utf-8")
