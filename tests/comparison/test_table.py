from __future__ import annotations

import csv
import io

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrgs_compare.table import (
    Cell,
    Group,
    Row,
    Table,
    marks,
    printed,
    to_csv,
    to_latex,
    to_markdown,
    to_plain,
)


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


def test_figures_within_the_spread_of_seeds_are_marked_alike():
    close = [Row(("x",), (Cell(mean, std, 3),)) for mean, std in ((31.0, 0.2), (30.9, 0.1))]
    assert column("thermal.psnr", *close, row(30.0)) == ["best", "best", "second"]
    unsure = Row(("x",), (Cell(29.0, 2.5, 3),))
    assert column("thermal.psnr", close[0], row(30.5), unsure) == ["best", "second", ""]
    even = [Row(("x",), (Cell(mean, 0.1, 3),)) for mean in (31.0, 30.9)]
    assert column("thermal.psnr", *even, row(30.0)) == ["best", "best", "second"]
    apart = [Row(("x",), (Cell(mean, std, 3),)) for mean, std in ((31.0, 0.2), (30.7, 0.1))]
    assert column("thermal.psnr", *apart, row(30.65)) == ["best", "second", "second"]


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


FIGURES = ("thermal.psnr", "thermal.mae_c")


@pytest.fixture
def table() -> Table:
    """Two methods on four scenes."""
    groups = tuple(Group(f"scene_{letter}", FIGURES) for letter in "abcd")
    good = tuple(Cell(value) for value in (31.0, 0.2) * 4)
    poor = (
        *(Cell(value) for value in (30.0, 0.3) * 3),
        Cell(29.0, 1.5, 2),
        Cell(None, note="100% | no °C, 1 < 2 > 0"),
    )
    rows = (Row(("ours",), good), Row(("their_s",), poor))
    return Table("thermal", "A caption.", ("",), groups, rows, ("A remark.",))


def test_markdown_marks_and_notes(table):
    text = to_markdown(table)
    assert text.startswith("**A caption.**\n\n|  | scene_a<br>PSNR, dB ↑ | scene_a<br>MAE, °C ↓ |")
    assert "| ours | **31.00** | **0.200** |" in text
    assert "| their_s | <u>30.00</u> | <u>0.300</u> |" in text
    assert "<u>29.00 ± 1.50</u> | –<sup>a</sup> |" in text
    assert "<sup>a</sup> 100% \\| no °C, 1 &lt; 2 &gt; 0." in text
    assert "A remark." in text


def test_markdown_is_cut_into_tables_of_three_scenes(table):
    lines = to_markdown(table).splitlines()
    headers = [line for line in lines if line.startswith("|  |")]
    assert [line.count("<br>") for line in headers] == [6, 2]
    for start in (lines.index(header) for header in headers):
        columns = {line.count("|") for line in lines[start : start + 4]}
        assert len(columns) == 1


def test_latex_marks_escapes_and_notes(table):
    text = to_latex(table)
    assert r"\multicolumn{2}{c}{\textit{scene\_a}}" in text
    assert r"ours & \textbf{31.00} & \textbf{0.200}" in text
    assert r"their\_s & \underline{30.00}" in text
    assert r"\underline{29.00 $\pm$ 1.50} & --$^{a}$ \\" in text
    assert r"$^{a}$ 100\% $|$ no $^{\circ}$C, 1 $<$ 2 $>$ 0." in text
    assert text.count(r"\begin{") == text.count(r"\end{")
    rows = [line for line in text.splitlines() if line.startswith(("ours", "their"))]
    assert [row.count("&") for row in rows] == [8, 8]


@pytest.mark.parametrize(("label", "escaped"), [("[7] theirs", "{[}7] theirs"), ("*", "{*}")])
def test_latex_takes_no_name_for_a_part_of_the_row_before(label, escaped):
    rows = tuple(Row((name,), (Cell(1.0),)) for name in ("ours", label))
    text = to_latex(Table("t", "c", ("",), (Group("s", ("thermal.psnr",)),), rows))
    assert f"\n{escaped} & " in text


def test_plain_text_is_aligned_and_marked(table):
    blocks = to_plain(table).split("\n\n")
    assert blocks[0] == "A caption."
    heading, columns, ours, theirs = blocks[4].splitlines()
    assert heading == "scene_d"
    assert ours.split() == ["ours", "31.00*", "0.200"]
    assert theirs.split() == ["their_s", "29.00", "±", "1.50+", "–"]
    assert columns.index("↑") == theirs.index("+")


def test_csv_has_a_line_per_figure_with_all_decimals(table):
    rows = list(csv.DictReader(io.StringIO(to_csv(table))))
    assert len(rows) == 2 * 4 * 2
    last = rows[-1]
    assert (last["method"], last["group"], last["figure"], last["unit"]) == (
        "their_s",
        "scene_d",
        "MAE",
        "°C",
    )
    assert (last["mean"], last["note"]) == ("", "100% | no °C, 1 < 2 > 0")
    assert (rows[-2]["mean"], rows[-2]["std"], rows[-2]["seeds"], rows[-2]["mark"]) == (
        "29.0",
        "1.5",
        "2",
        "second",
    )


def test_a_spreadsheet_runs_nothing_that_a_folder_is_named_or_an_error_says():
    rows = (Row(("=1+1",), (Cell(-1.5, note="-2: gone"),)),)
    table = Table("t", "c", ("",), (Group("@scene", ("thermal.psnr",)),), rows)
    (row,) = csv.DictReader(io.StringIO(to_csv(table)))
    assert (row["method"], row["group"], row["note"]) == ("'=1+1", "'@scene", "'-2: gone")
    assert row["mean"] == "-1.5"


def test_equal_notes_share_a_letter_and_there_are_more_than_26():
    cells = [Cell(None, note=f"reason {index % 30}") for index in range(60)]
    groups = tuple(Group(str(index), ("thermal.psnr",)) for index in range(60))
    text = to_markdown(Table("t", "Many.", ("",), groups, (Row(("x",), tuple(cells)),)))
    assert text.count("<sup>ad</sup>") == 3  # twice in the table, once below
    assert "<sup>ae</sup>" not in text
