"""A table of figures, independent of how it is written down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from mrgs.comparison.results import Cell, kind_of

Mark = Literal["best", "second", ""]


class Group(NamedTuple):
    """Columns under a common heading, usually a scene; ``figures`` are ``figure_keys``."""

    heading: str
    figures: tuple[str, ...]


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Attributes:
        labels: the first columns.
        cells: one per figure of every group, in order.
        block: rows of one block are ranked against each other.
        published: the figures are the paper's: printed with its decimals, and not ranked.
    """

    labels: tuple[str, ...]
    cells: tuple[Cell, ...]
    block: str = ""
    published: bool = False


@dataclass(frozen=True)
class Table:
    """A table of figures.

    Attributes:
        name: the file's stem.
        caption: what it shows, one sentence.
        label_headings: of the first columns.
        groups: of the other columns.
        rows: from top to bottom.
        remarks: sentences below it.
    """

    name: str
    caption: str
    label_headings: tuple[str, ...]
    groups: tuple[Group, ...]
    rows: tuple[Row, ...]
    remarks: tuple[str, ...] = ()

    @property
    def figures(self) -> list[str]:
        """The figure of every column of cells."""
        return [name for group in self.groups for name in group.figures]


def printed(cell: Cell, figure: str, published: bool) -> str:
    """The cell's number as the tables show it, without its mark; a dash where there is none."""
    kind = kind_of(figure)
    if cell.mean is None:
        return "–"
    decimals = kind.paper_decimals if published else kind.decimals
    deviation = "" if cell.std is None else f" ± {cell.std:,.{decimals}f}"
    return f"{cell.mean:,.{decimals}f}{deviation}"


def marks(table: Table) -> list[list[Mark]]:
    """Marks of the best and the second best measured rows of each block, by row and column.

    Figures that are printed alike are marked alike. A column with fewer than two measured figures
    has no marks.
    """
    result: list[list[Mark]] = [["" for _ in table.figures] for _ in table.rows]
    for column, figure in enumerate(table.figures):
        for block in dict.fromkeys(row.block for row in table.rows):
            members = [
                index
                for index, row in enumerate(table.rows)
                if row.block == block and not row.published
            ]
            for index, mark in _rank(table, members, column, figure).items():
                result[index][column] = mark
    return result


def _rank(table: Table, members: Sequence[int], column: int, figure: str) -> dict[int, Mark]:
    kind = kind_of(figure)
    values = {
        index: round(mean, kind.decimals)
        for index in members
        if (mean := table.rows[index].cells[column].mean) is not None
    }
    if kind.better is None or len(values) < 2:
        return {}
    order = sorted(set(values.values()), reverse=kind.better == "higher")
    ranked: dict[float, Mark] = dict(zip(order, ("best", "second"), strict=False))
    return {index: ranked[value] for index, value in values.items() if value in ranked}
