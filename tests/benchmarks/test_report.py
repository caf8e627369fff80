from __future__ import annotations

import pytest

from benchmarks.chart import draw, points
from benchmarks.prototype import ADAM, FUSED, MLP, SSIM_CONV, SSIM_SHIFTED
from benchmarks.report import CALIBRATIONS, milliseconds, table, to_markdown, with_load
from benchmarks.targets import TARGETS
from tests.benchmarks.tables import rows

MACHINE = {"processor": "P", "threads": 2, "cores": 2, "python": "3", "torch": "2", "numba": "0"}


def case(
    group: str, gaussians=None, width=None, calibration_ms: float = 1.0, **stages_ms: float
) -> dict:
    height = None if width is None else width * 3 // 4
    times = {**dict.fromkeys(CALIBRATIONS, calibration_ms), **stages_ms}
    timings = {name: {"median_ms": ms, "runs": 12} for name, ms in times.items()}
    size = {"group": group, "gaussians": gaussians, "width": width, "height": height}
    return {**size, "timings": timings, "peak_bytes": 3_000_000, "notes": {}}


def test_a_table_is_markdown():
    text = table(["a", "b"], [["1", "2"]])
    assert rows(text) == [["a", "b"], ["---", "---"], ["1", "2"]]


@pytest.mark.parametrize(
    ("median_ms", "runs", "text"),
    [(0.1234, 12, "0.12"), (3.14, 12, "3.1"), (1234.5, 12, "1,234"), (250.0, 5, "250 (5)")],
)
def test_a_median_of_few_runs_is_marked(median_ms, runs, text):
    assert milliseconds({"median_ms": median_ms, "runs": runs}) == text


def test_load_is_relative_to_the_quietest_case():
    skipped = {
        "group": "gsplat",
        "gaussians": 1,
        "width": 320,
        "height": 240,
        "skipped": "not installed",
    }
    cases = with_load(
        [case("adam", 10, calibration_ms=2.0), case("adam", 20, calibration_ms=3.0), skipped]
    )
    assert [c.get("load") for c in cases] == [1.0, 1.5, None]


def test_the_report_shows_what_was_measured_and_what_was_not():
    skipped = {
        "group": "losses",
        "gaussians": None,
        "width": 640,
        "height": 480,
        "skipped": "out of memory",
    }
    markdown = to_markdown(
        {"machine": MACHINE, "cases": [case("losses", None, 320, radiation=4.5), skipped]}
    )
    assert ["320×240", "4.5", "3", "1.00"] in rows(markdown)
    assert ["640×480", "–", "–", "–"] in rows(markdown)
    assert "out of memory" in markdown
    assert "Targets" not in markdown


@pytest.mark.parametrize(
    ("calibration_ms", "end"), [(1.0, ["missed", "1.00"]), (1.5, ["undecided", "1.50"])]
)
def test_the_report_compares_with_the_prototype(calibration_ms, end):
    known = {FUSED: 100.5, MLP: 39.0, SSIM_CONV: 200.0, SSIM_SHIFTED: 124.0, ADAM: 3.0}
    cases = [case("adam", 10), case("prototype", 50_000, 640, calibration_ms, **known)]
    markdown = to_markdown({"machine": MACHINE, "cases": cases})
    figures = ["50,000, 640×480", "100", "67", "88", "1.50", "1.50", "1.3"]
    assert [*figures, *end] in rows(markdown)


@pytest.mark.parametrize(("ms", "verdict"), [(100.0, "met"), (130.0, "missed")])
def test_a_target_is_met_up_to_its_limit(ms, verdict):
    markdown = to_markdown({"machine": MACHINE, "cases": [case("mrgs", 50_000, 320, step=ms)]})
    assert [f"{ms:.0f} ms", "125 ms", verdict] in [cells[1:] for cells in rows(markdown)]


def test_targets_name_stages_that_exist():
    """Measured by the smoke test under these names."""
    from benchmarks.stages import losses, training

    known = {losses.PHOTOMETRIC, training.STEP, training.EVENT, training.RENDER, None}
    assert {target.timing for target in TARGETS} <= known


def test_memory_is_a_target_in_gigabytes():
    (target,) = [target for target in TARGETS if target.timing is None]
    assert target.value([case("mrgs", 200_000, 640, step=1.0)]) == pytest.approx(0.003)
    assert target.value([case("mrgs", 50_000, 640, step=1.0)]) is None


CASES = [case("mrgs", n, w, step=float(n * w)) for n in (10_000, 50_000) for w in (320, 640)] + [
    case("adam", 50_000, Adam=2.0)
]


def test_a_curve_varies_one_thing():
    assert points(CASES, "mrgs", "step", "gaussians") == [(10_000, 6.4e6), (50_000, 3.2e7)]
    assert points(CASES, "mrgs", "step", "pixels") == [(320 * 240, 1.6e7), (640 * 480, 3.2e7)]
    assert points(CASES, "adam", "Adam", "gaussians") == [(50_000, 2.0)]
    assert points(CASES, "adam", "Adam", "pixels") == []


def test_the_chart_is_a_picture(tmp_path):
    pytest.importorskip("matplotlib")
    draw(CASES, tmp_path / "chart.png")
    assert (tmp_path / "chart.png").read_bytes().startswith(b"\x89PNG")
