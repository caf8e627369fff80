from __future__ import annotations

import json

import pytest

from benchmarks.quality import __main__ as quality
from benchmarks.quality import child
from benchmarks.quality.plan import (
    Curve,
    Job,
    Point,
    Variant,
    curve_from_json,
    curve_to_json,
    jobs_of,
    time_until,
    variants_of,
)
from benchmarks.quality.report import to_markdown
from tests.benchmarks.tables import rows

FIRST, SECOND = Variant("mrgs", "fast"), Variant("mrgs", "fast", "abc1234", "small")


def point(cpu_s: float, **scores: float) -> Point:
    return Point(step=int(cpu_s), cpu_s=cpu_s, wall_s=2 * cpu_s, gaussians=100, scores=scores)


def curve(variant: Variant, *points: Point) -> Curve:
    return Curve(Job(variant, "/scenes/a", 0), list(points))


def test_a_variant_is_named_by_what_is_not_the_usual():
    assert FIRST.name == "mrgs fast"
    for part in ("small", "@abc1234"):
        assert part in SECOND.name
        assert part not in FIRST.name


def test_trainings_take_turns():
    variants = variants_of(["mrgs"], ["fast", "default"], ["now"], [""])
    jobs = jobs_of(variants, ["a", "b"], 2)
    assert [(job.seed, job.scene, job.variant.preset) for job in jobs[:4]] == [
        (0, "a", "fast"), (0, "a", "default"), (0, "b", "fast"), (0, "b", "default"),
    ]  # fmt: skip
    assert len(set(jobs)) == 8


@pytest.mark.parametrize(
    ("target", "expected"), [(20.0, 10.0), (10.0, 10.0), (25.0, 15.0), (30.0, 20.0), (31.0, None)]
)
def test_the_time_until_a_target_lies_on_a_line_between_points(target, expected):
    points = [point(10, thermal=20.0), point(20, thermal=30.0), point(30, thermal=29.0)]
    assert time_until(points, "thermal", target, "cpu_s") == expected


def test_an_error_is_reached_from_above():
    points = [point(10, error=2.0), point(20, error=1.0)]
    assert time_until(points, "error", 1.25, "wall_s") == pytest.approx(35)
    assert time_until(points, "rgb", 20.0, "wall_s") is None


def test_curves_survive_their_file():
    written = curve(SECOND, point(10, thermal=20.0, error=1.5))
    assert curve_from_json(json.loads(json.dumps(curve_to_json(written)))) == written


def test_the_report_gives_ratios_to_the_first_variant():
    curves = [
        curve(FIRST, point(50, thermal=20.0, rgb=10.0), point(100, thermal=40.0, rgb=20.0)),
        curve(SECOND, point(20, thermal=40.0, rgb=19.0), point(40, thermal=42.0, rgb=20.0)),
    ]
    text = to_markdown(curves, {"thermal": 41.0}, ["a machine"])
    processor = text.split("processor time over")[1].split("clock time over")[0]
    found = {name: cells for name, *cells in rows(processor)}
    no, once = "0 of 1", "1.00 (1.00–1.00), 1 of 1"
    assert found[FIRST.name] == [no, once, no, no]
    less, least = "0.40 (0.40–0.40), 1 of 1", "0.30 (0.30–0.30), 1 of 1"
    assert found[SECOND.name] == [least, less, no, less]
    assert [FIRST.name, "40.00", "20.00", "–", "100", "100", "200"] in rows(text)


def test_clocks_leave_out_pauses():
    now = iter([(0.0, 0.0), (5.0, 6.0), (9.0, 16.0), (10.0, 20.0)])
    clocks = child.Clocks(now=lambda: next(now))
    clocks.pause()
    clocks.go_on()
    assert clocks.read() == (6.0, 10.0)


def test_scores_come_from_the_metrics_of_a_run():
    metrics = {
        "mean": {"thermal": {"psnr": 40.0}, "rgb": {"psnr": None}},
        "truth": {"mae_c": 0.1, "camera_mae_c": 0.2},
    }
    assert child.scores_of(metrics) == {"thermal": 40.0, "error": 0.5}
    assert child.scores_of({"mean": {"rgb": {"psnr": 20.0}}, "truth": None}) == {"rgb": 20.0}


def test_a_tiny_benchmark_runs_to_its_report(small_scene, tmp_path):
    options = ["--max-steps", "4", "--max-gaussians", "50", "--points", "2", "--seeds", "1"]
    output = tmp_path / "out"
    arguments = [str(small_scene), *options, "--threads", "1", "--output", str(output)]
    pytest.importorskip("matplotlib")
    assert quality.main(arguments) == 0
    (entry,) = json.loads((output / "quality.json").read_text())["curves"]
    assert [p["step"] for p in entry["points"]] == [2, 4]
    assert all(p["scores"]["thermal"] > 5 for p in entry["points"])
    assert (output / "quality.png").stat().st_size > 10_000
    assert "mrgs-plus fast" in (output / "quality.md").read_text()
