from __future__ import annotations

import re
import statistics
from dataclasses import replace

import pytest

from mrgs.evaluation.metrics import Missing
from mrgs_compare.paper_tables import (
    ABLATION,
    NAMES,
    PAPER_METHODS,
    Outcomes,
    all_tables,
    published,
    published_figure,
    published_rows,
    scene_title,
)
from mrgs_compare.table import Outcome, Table, failed
from tests.helpers.comparison import metrics_document, outcome_of

PAPER_SCENES = tuple(published()["scenes"])
TRUTH = {"mae_c": 0.2, "camera_mae_c": 0.4, "depth_median_relative_error": 0.015}
ALIGNED = {
    "error_px": 1.7,
    "aligned": {"thermal": {"psnr": 44.0, "mae_c": 0.3}, "rgb": {"psnr": 30.0}, "truth": TRUTH},
}
NO_CELSIUS = {
    "thermal": {"psnr": 20.0, "psnr_matched": 26.0, "ssim": 0.9, "mae_c": None},
    "rgb": {},
}


def gathered(*all: Outcome, neighbours: dict[int, str] | None = None) -> Outcomes:
    scenes = tuple(dict.fromkeys(each.scene for each in all))
    methods = tuple(
        dict.fromkeys(each.method for each in all if not each.method.startswith("mrgs-n"))
    )
    return Outcomes(all, scenes, methods, neighbours or {})


def tables_of(outcomes: Outcomes) -> dict[str, Table]:
    return {table.name: table for table in all_tables(outcomes)}


def labels(table: Table) -> list[tuple[str, ...]]:
    return [row.labels for row in table.rows]


def test_thermal_and_rgb_tables_have_a_mean_over_scenes():
    runs = [outcome_of(scene, "mrgs", psnr=psnr) for scene, psnr in (("a", 30.0), ("b", 34.0))]
    tables = tables_of(gathered(*runs))
    assert set(tables) == {"thermal", "rgb"}
    thermal = tables["thermal"]
    assert [group.heading for group in thermal.groups] == ["a", "b", "mean"]
    assert [cell.mean for cell in thermal.rows[0].cells] == pytest.approx(
        [30, 0.95, 0.5, 12.34, 34, 0.95, 0.5, 12.34, 32, 0.95, 0.5, 12.34]
    )
    assert tables["rgb"].rows[0].cells[0].mean == pytest.approx(22.0)


def test_one_scene_has_no_mean():
    assert [
        group.heading for group in tables_of(gathered(outcome_of("a", "mrgs")))["thermal"].groups
    ] == ["a"]


def test_a_mean_leaves_out_scenes_where_no_method_has_the_figure():
    runs = [outcome_of("a", "mrgs"), outcome_of("b", "mrgs", mean=NO_CELSIUS)]
    thermal = tables_of(gathered(*runs))["thermal"]
    assert thermal.rows[0].cells[-2].mean == 0.5
    assert any(re.search(r"MAE .*\bb\b", remark) for remark in thermal.remarks)


def test_a_scene_without_celsius_has_the_matched_psnr_in_place_of_the_mae():
    runs = [outcome_of("a", "mrgs"), outcome_of("b", "mrgs", mean=NO_CELSIUS)]
    thermal = tables_of(gathered(*runs))["thermal"]
    paper = ("thermal.psnr", "thermal.ssim", "thermal.mae_c", "gaussians_k")
    without = ("thermal.psnr", "thermal.psnr_matched", "thermal.ssim", "gaussians_k")
    assert thermal.groups == (("a", paper), ("b", without), ("mean", paper))
    assert [cell.mean for cell in thermal.rows[0].cells[4:8]] == pytest.approx(
        [20.0, 26.0, 0.9, 12.34]
    )
    assert any(remark.startswith("PSNR matched") for remark in thermal.remarks)
    alone = [outcome_of(scene, "mrgs", mean=NO_CELSIUS) for scene in "bc"]
    assert [group.figures for group in tables_of(gathered(*alone))["thermal"].groups] == [
        without
    ] * 3


def test_scenes_with_celsius_and_scenes_without_figures_have_the_papers_columns():
    runs = [outcome_of("a", "mrgs"), failed("b", "mrgs", 0, "crash")]
    thermal = tables_of(gathered(*runs))["thermal"]
    assert [group.figures[2] for group in thermal.groups] == ["thermal.mae_c"] * 3
    assert not any(remark.startswith("PSNR matched") for remark in thermal.remarks)


def test_a_method_whose_run_failed_has_no_mean():
    runs = [
        outcome_of("a", "mrgs"),
        outcome_of("a", "x"),
        outcome_of("b", "mrgs"),
        failed("b", "x", 0, "crash"),
    ]
    mrgs, x = tables_of(gathered(*runs))["thermal"].rows
    assert mrgs.cells[8].mean == 30.0
    assert x.cells[4].note == "crash"
    assert "missing for b" in x.cells[8].note


def test_the_ablation_checks_what_each_method_has():
    names = ("3dgs-rgbt", "mrgs-base", "mrgs-fourier", "mrgs-boltz", "mrgs", "mrgs-plus")
    table = tables_of(gathered(*(outcome_of("a", name) for name in names)))["ablation"]
    assert labels(table) == [
        ("a", "✓", "", "", ""),
        ("a", "", "✓", "", ""),
        ("a", "", "✓", "✓", ""),
        ("a", "", "✓", "", "✓"),
        ("a", "", "✓", "✓", "✓"),
    ]


def test_the_neighbours_have_minutes_and_stay_out_of_the_other_tables():
    runs = [outcome_of("a", method) for method in ("mrgs", "mrgs-n1", "mrgs-n5")]
    tables = tables_of(gathered(*runs, neighbours={5: "mrgs-n5", 1: "mrgs-n1", 3: "mrgs"}))
    assert [(scene, label[-1]) for scene, label in labels(tables["neighbours"])] == [
        ("a", "1"), ("a", "3"), ("a", "5"),
    ]  # fmt: skip
    assert tables["neighbours"].rows[0].cells[-1].mean == pytest.approx(1.5)
    assert labels(tables["thermal"]) == [("mrgs",)]


def test_the_table_of_exact_truth_shows_only_scenes_that_have_it():
    runs = [outcome_of("real", "mrgs"), outcome_of("generated", "mrgs", truth=TRUTH)]
    table = tables_of(gathered(*runs))["truth"]
    assert [group.heading for group in table.groups] == ["generated"]
    assert [cell.mean for cell in table.rows[0].cells] == pytest.approx([0.2, 0.4, 0.5, 1.5])


def test_a_scene_with_exact_depths_alone_is_in_the_table_of_exact_truth():
    depth_alone = {"mae_c": None, "camera_mae_c": None, "depth_median_relative_error": 0.025}
    runs = [outcome_of("real", "mrgs"), outcome_of("generated", "mrgs", truth=TRUTH)]
    runs.append(outcome_of("lidar", "mrgs", truth=depth_alone, reasons={"truth.mae_c": "no °C"}))
    table = tables_of(gathered(*runs))["truth"]
    assert [group.heading for group in table.groups] == ["generated", "lidar", "mean"]
    cells = table.rows[0].cells
    assert (cells[4].mean, cells[4].note) == (None, "no °C")
    assert [cells[index].mean for index in (7, 8, 11)] == pytest.approx([2.5, 0.2, 2.0])
    headings = ("MAE to exact", "camera's own MAE", "ratio")
    for heading, remark in zip(headings, table.remarks[-3:], strict=True):
        assert heading in remark
        assert "lidar" in remark


def test_the_names_of_all_tables_are_known():
    runs = [
        outcome_of("a", method, truth=TRUTH, poses=ALIGNED)
        for method in ("3dgs-rgbt", "mrgs", "mrgs-n1")
    ]
    assert set(tables_of(gathered(*runs, neighbours={1: "mrgs-n1"}))) == set(NAMES)


def test_scenes_with_wrong_poses_have_scores_with_aligned_ones_too():
    right = {"error_px": 0.1}
    runs = [
        outcome_of("a", "3dgs-rgbt", poses=ALIGNED), outcome_of("a", "mrgs", poses=right),
        outcome_of("b", "3dgs-rgbt", poses=right), outcome_of("b", "mrgs", poses=right),
    ]  # fmt: skip
    table = tables_of(gathered(*runs))["aligned"]
    assert [group.heading for group in table.groups] == ["a"]
    wrong, fits = (row.cells for row in table.rows)
    assert [cell.mean for cell in wrong] == [1.7, 44.0, 30.0, 0.3, 0.2]
    assert [cell.mean for cell in fits] == [0.1, None, None, None, None]
    assert "poses" in fits[1].note
    assert "right" in fits[1].note
    assert "aligned" not in tables_of(gathered(*runs[2:]))
    unknown = {"error_px": None}
    reasons = {"poses.error_px": "not clear"}
    (row,) = tables_of(
        gathered(
            outcome_of("a", "mrgs", poses=ALIGNED),
            outcome_of("b", "mrgs", poses=ALIGNED | {"error_px": 3.7}),
            outcome_of("c", "mrgs", poses=right),
        )
    )["aligned"].rows
    assert row.cells[-5].mean == pytest.approx(2.7)
    told = tables_of(
        gathered(
            outcome_of("a", "3dgs-rgbt", poses=ALIGNED),
            outcome_of("a", "mrgs", poses=unknown, reasons=reasons),
        )
    )["aligned"].rows[1]
    assert told.cells[1].note == "not clear"


def test_the_papers_figures_stand_beside_ours_on_its_scenes():
    methods = ("3dgs-rgbt", "mrgs", "mrgs-n1")
    runs = [
        outcome_of(scene, method)
        for scene in ("buildingA_winter", "heater_water_cup")
        for method in methods
    ]
    tables = tables_of(gathered(*runs, neighbours={1: "mrgs-n1", 3: "mrgs"}))
    thermal = tables["thermal"]
    assert [group.heading for group in thermal.groups] == [
        "Building (Winter)",
        "Hot Water Cup",
        "mean",
    ]
    assert [label.removesuffix(" (paper)") for (label,) in labels(thermal)[2:]] == [
        "ThermoNeRF", "3DGS_RGB-T", "MrGS",
    ]  # fmt: skip
    assert [row.published for row in thermal.rows] == [False] * 2 + [True] * 3
    assert [thermal.rows[-1].cells[index].mean for index in (0, 4, 8)] == pytest.approx(
        [30.02, 31.44, 30.73]
    )
    assert [row.labels[0] for row in tables["ablation"].rows if row.published] == [
        "Building (Winter) (paper)"
    ] * 5
    cup = [row for row in tables["neighbours"].rows if row.published]
    assert [(row.labels[1][-1], row.cells[-1].mean) for row in cup] == [("1", 17.0), ("3", 27.0)]


def test_other_scenes_have_no_rows_of_the_paper():
    assert not any(
        row.published
        for table in all_tables(gathered(outcome_of("a", "mrgs")))
        for row in table.rows
    )


def test_a_method_without_outcomes_was_not_run():
    outcomes = replace(gathered(outcome_of("a", "mrgs")), methods=("mrgs", "mrgs-plus"))
    assert tables_of(outcomes)["thermal"].rows[1].cells[0].note == "not run"


def test_a_third_modality_has_a_table():
    means = metrics_document()["mean"] | {"nir": {"psnr": 33.0, "ssim": 0.9, "lpips": 0.1}}
    runs = [outcome_of("a", "mrgs", mean=means), outcome_of("b", "mrgs"), failed("a", "x", 0, "no")]
    tables = tables_of(gathered(*runs))
    assert list(tables) == ["thermal", "rgb", "nir"]
    nir = tables["nir"]
    assert nir.figures[:4] == ["nir.psnr", "nir.ssim", "nir.lpips", "gaussians_k"]
    assert nir.rows[0].cells[0].mean == 33.0
    assert [nir.rows[0].cells[4].note, nir.rows[1].cells[0].note] == ["not scored", "no"]


def test_the_ten_scenes_of_thermoscenes():
    assert len(PAPER_SCENES) == len(set(published()["scenes"].values())) == 10
    assert scene_title("heater_water_cup") == "Hot Water Cup"
    assert scene_title("tabletop") == "tabletop"


@pytest.mark.parametrize("table", ["thermal", "rgb"])
def test_the_large_tables_are_complete(table):
    third = "mae_c" if table == "thermal" else "lpips"
    for scene in PAPER_SCENES:
        assert tuple(published_rows(table, scene)) == PAPER_METHODS
        for row in published_rows(table, scene).values():
            assert tuple(row) == ("psnr", "ssim", third, "gaussians_k")


@pytest.mark.parametrize(
    ("table", "row", "psnr"),
    [
        ("thermal", "MrGS", 32.62),
        ("thermal", "3DGS_RGB-T", 31.35),
        ("thermal", "ThermoNeRF", 29.46),
        ("rgb", "MrGS", 22.08),
        ("rgb", "3DGS_RGB-T", 20.75),
        ("rgb", "ThermoNeRF", 19.48),
    ],
)
def test_the_averages_over_the_ten_scenes(table, row, psnr):
    figures = [published_figure(table, row, f"{table}.psnr", scene) for scene in PAPER_SCENES]
    assert statistics.mean(figures) == pytest.approx(psnr, abs=0.005)


def test_the_average_number_of_gaussians():
    counts = {
        row: statistics.mean(
            published_figure("thermal", row, "gaussians_k", scene) for scene in PAPER_SCENES
        )
        for row in ("MrGS", "3DGS_RGB-T")
    }
    assert counts == {"MrGS": pytest.approx(194.4), "3DGS_RGB-T": pytest.approx(468.8)}


def test_ablation_and_neighbours():
    winter = published_rows("ablation", "buildingA_winter")
    assert tuple(winter) == tuple(ABLATION)
    assert [row["psnr"] for row in winter.values()] == [27.95, 29.28, 29.53, 29.81, 30.02]
    assert [row["gaussians_k"] for row in winter.values()] == [342, 201, 160, 188, 155]
    cup = published_rows("neighbours", "heater_water_cup")
    assert {n: row["minutes"] for n, row in cup.items()} == {"1": 17, "3": 27, "5": 35, "7": 58}


def test_what_the_paper_does_not_say():
    for row, key, scene, word in (
        ("MrGS", "thermal.psnr", "tabletop", "this scene"),
        ("ThermoNeRF", "gaussians_k", "trees", "does not say"),
    ):
        figure = published_figure("thermal", row, key, scene)
        assert isinstance(figure, Missing)
        assert word in figure.reason
