from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from mrgs.comparison.results import Cell
from mrgs.comparison.table import Group, Row, Table, marks, printed


def column(figure: str, *rows: Row) -> list[str]:
    table = Table("t", "A table.", ("",), (Group("", (figure,)),), rows)
    return [row[0] for row in marks(table)]


def row(mean: float | None, block: str = "", published: bool = False) -> Row:
    return Row(("x",), (Cell(mean),), block, published)


def test_higher_or_lower_is_better_by_figure():
    assert column("thermal.psnr", row(30.0), row(32.0), row(31.0)) == ["", "best", "second"]
    assert column("thermal.mae_c", row(0.3), row(0.2), row(0.4)) == ["second", "best", ""]


def test_figures_printed_alike_are_marked_alike():
    assert column("thermal.psnr", row(30.001), row(30.004), row(29.0), row(28.0)) == [
        "best",
        "best",
        "second",
        "",
    ]
    assert column("thermal.psnr", row(31.0), row(30.001), row(30.004)) == [
        "best",
        "second",
        "second",
    ]


def test_blocks_are_ranked_apart():
    assert column("thermal.psnr", row(30.0, "a"), row(20.0, "a"), row(5.0, "b"), row(6.0, "b")) == [
        "best", "second", "second", "best",
    ]  # fmt: skip


def test_published_and_missing_figures_are_not_ranked():
    assert column("thermal.psnr", row(30.0), row(99.0, published=True), row(None), row(29.0)) == [
        "best", "", "", "second",
    ]  # fmt: skip


def test_nothing_is_marked_where_there_is_nothing_to_compare():
    assert column("thermal.psnr", row(30.0), row(None)) == ["", ""]
    assert column("truth.camera_mae_c", row(0.3), row(0.2)) == ["", ""]


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=6))
def test_no_figure_is_better_than_the_best(values):
    found = column("thermal.psnr", *map(row, values))
    best = [round(value, 2) for value, mark in zip(values, found, strict=True) if mark == "best"]
    others = [round(value, 2) for value, mark in zip(values, found, strict=True) if mark != "best"]
    assert len(set(best)) == 1
    assert all(value < best[0] for value in others)


def test_printing():
    assert printed(Cell(30.126, 0.051), "thermal.psnr", published=False) == "30.13 ± 0.05"
    assert printed(Cell(1100.0), "gaussians_k", published=True) == "1,100"
    assert printed(Cell(0.97), "thermal.ssim", published=True) == "0.970"
    assert printed(Cell(None, note="why"), "thermal.psnr", published=False) == "–"
