from __future__ import annotations

import statistics

import pytest

from mrgs.evaluation.metrics import Missing
from mrgs_compare.table import failed, figure_keys, kind_of, outcome, over_scenes, over_seeds
from tests.helpers.comparison import metrics_document

TRUTH = {"mae_c": 0.2, "camera_mae_c": 0.4, "depth_median_relative_error": 0.015}


def test_figures_of_a_document():
    figures = outcome("board", "mrgs", 0, metrics_document(31.5, truth=TRUTH)).figures
    assert tuple(figures) == figure_keys(())
    assert figures["thermal.psnr"] == 31.5
    assert (figures["thermal.psnr_matched"], figures["rgb.psnr_matched"]) == (32.5, 24.5)
    assert figures["gaussians_k"] == pytest.approx(12.34)
    assert figures["minutes"] == pytest.approx(1.5)
    assert figures["truth.ratio"] == pytest.approx(0.5)
    assert figures["truth.depth_percent"] == pytest.approx(1.5)


def test_a_missing_figure_keeps_the_reason_of_the_document():
    figures = outcome("board", "mrgs", 0, metrics_document()).figures
    assert figures["rgb.lpips"] == Missing("no weights")
    assert "exact truth" in figures["truth.ratio"].reason


def test_a_ratio_needs_both_of_its_figures():
    document = metrics_document(
        truth=TRUTH | {"mae_c": None}, reasons={"truth.mae_c": "no thermal image"}
    )
    assert outcome("a", "b", 0, document).figures["truth.ratio"] == Missing("no thermal image")
    document = metrics_document(truth=TRUTH | {"camera_mae_c": 0.0})
    assert "camera" in outcome("a", "b", 0, document).figures["truth.ratio"].reason


def test_a_document_of_another_shape_has_no_figures():
    figures = outcome("a", "b", 0, {"mean": [1], "gaussians": True, "reasons": 3}).figures
    assert figures["thermal.psnr"] == figures["gaussians_k"]
    assert "metrics.json" in figures["gaussians_k"].reason


def test_all_figures_of_a_failed_run_have_its_reason():
    each = failed("a", "mrgs", 1, "out of memory")
    assert set(each.figures.values()) == {Missing("out of memory")}
    assert each.failure == "out of memory"


def test_mean_and_sample_standard_deviation_over_seeds():
    cell = over_seeds([1.0, 2.0, 4.0])
    assert cell.mean == pytest.approx(7 / 3)
    assert cell.std == pytest.approx(statistics.stdev([1, 2, 4]))
    assert (cell.seeds, cell.note) == (3, None)
    assert over_seeds([1.0]).std is None


def test_seeds_that_are_missing_are_noted():
    cell = over_seeds([1.0, Missing("it crashed"), 3.0])
    assert (cell.mean, cell.seeds) == (2.0, 2)
    assert "2 of 3" in cell.note
    assert "it crashed" in cell.note
    assert over_seeds([Missing("x"), Missing("x")]) == (None, None, 0, "x")


def test_the_deviation_of_a_mean_over_scenes_is_that_over_seeds():
    cell = over_scenes([[1.0, 2.0], [3.0, 6.0]], ["a", "b"])
    assert cell.mean == pytest.approx(3.0)
    assert cell.std == pytest.approx(statistics.stdev([2.0, 4.0]))


def test_a_mean_over_scenes_needs_all_of_them():
    assert "missing for b" in over_scenes([[1.0], [Missing("it crashed")]], ["a", "b"]).note
    assert over_scenes([[Missing("no °C")], [Missing("no °C")]], ["a", "b"]).note == "no °C"


def test_seeds_that_lack_a_scene_are_noted():
    lost = Missing("it crashed")
    cell = over_scenes([[1.0, 2.0, 4.0], [3.0, lost, 8.0]], ["a", "b"])
    assert (cell.mean, cell.seeds) == (4.0, 2)
    assert "2 of 3" in cell.note
    assert "scene" in cell.note
    one_seed = over_scenes([[1.0, 2.0], [3.0, lost]], ["a", "b"])
    assert one_seed[:3] == (2.0, None, 1)
    assert "1 of 2" in one_seed.note
    assert over_scenes([[1.0, 2.0], [3.0, 4.0]], ["a", "b"]).note is None


def test_a_third_modality_has_figures():
    mean = metrics_document()["mean"] | {"nir": {"psnr": 33.0, "ssim": 0.9, "lpips": 0.1}}
    each = outcome("board", "mrgs", 0, metrics_document(mean=mean))
    assert each.modalities == ("thermal", "rgb", "nir")
    assert each.figures["nir.psnr"] == 33.0
    assert kind_of("nir.psnr") == kind_of("rgb.psnr")
    assert "nir.mae_c" not in each.figures
