from __future__ import annotations

import statistics

import pytest

from mrgs.comparison import paper
from mrgs.comparison.paper import cell, mean_cell, published, rows_of, scene_title
from mrgs.comparison.tables import ABLATION

SCENES = tuple(published()["scenes"])


def test_the_ten_scenes_of_thermoscenes():
    assert len(SCENES) == len(set(published()["scenes"].values())) == 10
    assert scene_title("heater_water_cup") == "Hot Water Cup"
    assert scene_title("tabletop") is None


@pytest.mark.parametrize("table", ["thermal", "rgb"])
def test_the_large_tables_are_complete(table):
    third = "mae_c" if table == "thermal" else "lpips"
    for scene in SCENES:
        assert tuple(rows_of(table, scene)) == paper.METHODS
        for row in rows_of(table, scene).values():
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
    assert mean_cell(table, SCENES, row, f"{table}.psnr").mean == pytest.approx(psnr, abs=0.005)


def test_the_average_number_of_gaussians():
    counts = {
        row: statistics.mean(cell("thermal", scene, row, "gaussians_k").mean for scene in SCENES)
        for row in ("MrGS", "3DGS_RGB-T")
    }
    assert counts == {"MrGS": pytest.approx(194.4), "3DGS_RGB-T": pytest.approx(468.8)}


def test_ablation_and_neighbours():
    winter = rows_of("ablation", "buildingA_winter")
    assert tuple(winter) == tuple(ABLATION)
    assert [row["psnr"] for row in winter.values()] == [27.95, 29.28, 29.53, 29.81, 30.02]
    assert [row["gaussians_k"] for row in winter.values()] == [342, 201, 160, 188, 155]
    cup = rows_of("neighbours", "heater_water_cup")
    assert {n: row["minutes"] for n, row in cup.items()} == {"1": 17, "3": 27, "5": 35, "7": 58}


def test_what_the_paper_does_not_say():
    assert "this scene" in cell("thermal", "tabletop", "MrGS", "thermal.psnr").note
    assert "does not say" in cell("thermal", "trees", "ThermoNeRF", "gaussians_k").note
    assert mean_cell("thermal", ("trees", "tabletop"), "MrGS", "thermal.psnr").mean is None
