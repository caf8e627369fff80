"""Tables of figures, and their texts in Markdown, LaTeX, CSV and for a terminal."""

from __future__ import annotations

import csv
import io
import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from string import ascii_lowercase
from typing import Any, Literal, NamedTuple, get_args

from mrgs.evaluation.metrics import REPORTED, Figure, Missing
from mrgs.pictures.escape import escape_cell, escape_markdown
from mrgs.scene import THERMAL
from mrgs.system.wording import aligned

Mark = Literal["best", "second", ""]


class Kind(NamedTuple):
    """Properties of a figure: the decimals it is printed with, here and in the paper, and which
    direction is better; None where neither is (the camera's own error)."""

    heading: str
    unit: str
    decimals: int
    paper_decimals: int
    better: Literal["higher", "lower"] | None


IMAGE_KINDS = {
    "psnr": Kind("PSNR", "dB", 2, 2, "higher"),
    "psnr_matched": Kind("PSNR matched", "dB", 2, 2, "higher"),
    "ssim": Kind("SSIM", "", 4, 3, "higher"),
    "mae_c": Kind("MAE", "°C", 3, 3, "lower"),
    "lpips": Kind("LPIPS", "", 4, 3, "lower"),
}
"""The figures of one modality's images; their keys are ``MODALITY.NAME``."""

RUN_KINDS = {
    "gaussians_k": Kind("Gaussians", "K", 1, 0, "lower"),
    "minutes": Kind("training", "min", 1, 0, "lower"),
    "truth.mae_c": Kind("MAE to exact", "°C", 3, 3, "lower"),
    "truth.camera_mae_c": Kind("camera's own MAE", "°C", 3, 3, None),
    "truth.ratio": Kind("ratio", "", 2, 2, "lower"),
    "truth.depth_percent": Kind("depth error", "%", 2, 2, "lower"),
    "poses.error_px": Kind("pose error", "px", 1, 1, None),
    "poses.aligned.thermal.psnr": Kind("thermal PSNR", "dB", 2, 2, "higher"),
    "poses.aligned.rgb.psnr": Kind("RGB PSNR", "dB", 2, 2, "higher"),
    "poses.aligned.thermal.mae_c": Kind("thermal MAE", "°C", 3, 3, "lower"),
    "poses.aligned.truth.mae_c": Kind("MAE to exact", "°C", 3, 3, "lower"),
}
"""The figures of a run."""


@dataclass(frozen=True)
class Outcome:
    """The result of one run, or of one set of another program's renders, which has no seed: the
    content of ``metrics.json``, or None and why there is none."""

    scene: str
    method: str
    seed: int | None
    figures: dict[str, Figure]
    document: dict[str, Any] | None
    failure: str | None = None

    @property
    def modalities(self) -> tuple[str, ...]:
        """Names of the modalities that were scored."""
        return () if self.document is None else _scored(self.document)


class Cell(NamedTuple):
    """Mean and sample standard deviation over seeds, None for fewer than two; ``note`` says why the
    mean is missing, or what it leaves out."""

    mean: float | None
    std: float | None = None
    seeds: int = 0
    note: str | None = None


def kind_of(figure: str) -> Kind:
    """Kind of a figure, by its key (one of ``figure_keys``)."""
    group, _, key = figure.partition(".")
    return RUN_KINDS[figure] if figure in RUN_KINDS else IMAGE_KINDS[key or group]


def figure_keys(modalities: Sequence[str]) -> tuple[str, ...]:
    """Keys of all figures in tables; of thermal images the MAE in °C, of all others LPIPS."""
    names = dict.fromkeys((*(modality.name for modality in REPORTED), *modalities))
    images = [
        f"{name}.{key}"
        for name in names
        for key in IMAGE_KINDS
        if key != ("lpips" if name == THERMAL.name else "mae_c")
    ]
    return (*images, *RUN_KINDS)


def outcome(scene: str, method: str, seed: int | None, document: dict[str, Any]) -> Outcome:
    """Read the figures of a ``metrics.json``."""
    figures = {key: _figure(document, key) for key in figure_keys(_scored(document))}
    return Outcome(scene, method, seed, figures, document)


def _scored(document: dict[str, Any]) -> tuple[str, ...]:
    """Names of the modalities of a ``metrics.json``."""
    means = document.get("mean")
    return tuple(means) if isinstance(means, dict) else ()


def failed(scene: str, method: str, seed: int | None, reason: str) -> Outcome:
    """The outcome of a failed run: all figures are missing for one reason."""
    return Outcome(
        scene, method, seed, {key: Missing(reason) for key in figure_keys(())}, None, reason
    )


def over_seeds(figures: Sequence[Figure]) -> Cell:
    """Mean ± standard deviation of the seeds with the figure; a note if some or all lack it."""
    values = [figure for figure in figures if not isinstance(figure, Missing)]
    missing = (figure.reason for figure in figures if isinstance(figure, Missing))
    reasons = "; ".join(dict.fromkeys(missing))
    return _cell(values, len(figures), reasons or "not run", f"the others: {reasons}")


def over_scenes(scenes: Sequence[Sequence[Figure]], names: Sequence[str]) -> Cell:
    """Mean over scenes of seeds that have all of them, and its standard deviation over seeds."""
    per_seed = []
    for seed in zip(*scenes, strict=True):
        values = [figure for figure in seed if not isinstance(figure, Missing)]
        if len(values) == len(scenes):
            per_seed.append(math.fsum(values) / len(values))
    why = "" if per_seed else _why_no_mean(scenes, names)
    return _cell(per_seed, len(scenes[0]), why, "the others lack a scene")


def _cell(values: Sequence[float], seeds: int, if_none: str, if_fewer: str) -> Cell:
    """Mean and deviation; with a note if there are no values, or fewer than seeds."""
    if not values:
        return Cell(None, note=if_none)
    note = None if len(values) == seeds else f"{len(values)} of {seeds} seeds; {if_fewer}"
    std = statistics.stdev(values) if len(values) > 1 else None
    return Cell(math.fsum(values) / len(values), std, len(values), note)


def _why_no_mean(scenes: Sequence[Sequence[Figure]], names: Sequence[str]) -> str:
    """The reason that all share, or the scenes that lack the figure."""
    every = [figure for figures in scenes for figure in figures]
    reasons = {figure.reason for figure in every if isinstance(figure, Missing)}
    if len(reasons) == 1 and all(isinstance(figure, Missing) for figure in every):
        return reasons.pop()
    gaps = [
        name
        for name, own in zip(names, scenes, strict=True)
        if any(isinstance(figure, Missing) for figure in own)
    ]
    return f"no mean, because the figure is missing for {', '.join(gaps)}"


_SCALED = {
    "gaussians_k": ("gaussians", 1e-3),
    "minutes": ("train_seconds", 1 / 60),
    "truth.depth_percent": ("truth.depth_median_relative_error", 100.0),
}
"""Figures that tables give in another unit than ``metrics.json``: their place there, a factor."""


def _figure(document: dict[str, Any], name: str) -> Figure:
    if name.startswith("truth.") and "truth" not in document:
        return Missing("the scene has no exact truth")
    if name == "truth.ratio":
        error, camera = _number(document, "truth.mae_c"), _number(document, "truth.camera_mae_c")
        if isinstance(error, Missing) or isinstance(camera, Missing):
            return error if isinstance(error, Missing) else camera
        return error / camera if camera > 0 else Missing("the camera makes no error")
    poses = document.get("poses")
    if name.startswith("poses.aligned") and isinstance(poses, dict) and "aligned" not in poses:
        right = "the poses of the held-out photos are right, as far as this model tells"
        error_px = _number(document, "poses.error_px")
        return error_px if isinstance(error_px, Missing) else Missing(right)
    path, factor = _SCALED.get(name, (name if name in RUN_KINDS else f"mean.{name}", 1.0))
    figure = _number(document, path)
    return figure if isinstance(figure, Missing) else figure * factor


def _number(document: dict[str, Any], path: str) -> Figure:
    """The number at a dotted path, or the reason that ``metrics.json`` gives for its absence."""
    node: Any = document
    for key in path.split("."):
        node = node.get(key) if isinstance(node, dict) else None
    if isinstance(node, int | float) and not isinstance(node, bool):
        return float(node)
    reasons = document.get("reasons")
    reason = reasons.get(path) if isinstance(reasons, dict) else None
    return Missing(str(reason) if reason else "metrics.json does not hold it")


MARKDOWN_GROUPS = 3
LATEX_GROUPS = 5
"""More scenes than these go into further tables below: a page is not wider."""

LEGEND = (
    "Bold: the best, underlined: the second best of what was measured here; alike where the "
    "difference is within the ± of the better one."
)

_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}",
    "[": "{[}", "*": "{*}",  # which behind the end of a row would belong to it
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "°": r"$^{\circ}$", "±": r"$\pm$",
    "–": "--",
    "↑": r"$\uparrow$", "↓": r"$\downarrow$", "✓": r"\checkmark{}", "²": r"$^{2}$",
    "λ": r"$\lambda$",
    "×": r"$\times$", "σ": r"$\sigma$", "−": "$-$", "|": "$|$", "<": "$<$", ">": "$>$",
}  # fmt: skip


class Group(NamedTuple):
    """Columns under a common heading, usually a scene; ``figures`` are ``figure_keys``."""

    heading: str
    figures: tuple[str, ...]


@dataclass(frozen=True)
class Row:
    """A line of the table, a cell for each figure of every group. Rows of one block are ranked
    against each other, without ``published`` ones, which are the paper's, with its decimals."""

    labels: tuple[str, ...]
    cells: tuple[Cell, ...]
    block: str = ""
    published: bool = False


@dataclass(frozen=True)
class Table:
    """A table of figures."""

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
    """Marks of the best and the second best measured rows of each block, by row and column. Figures
    printed alike, or within the standard deviation of the one before them over its seeds, are
    marked alike; a column with fewer than two has no marks."""
    result: list[list[Mark]] = [["" for _ in table.figures] for _ in table.rows]
    for column, figure in enumerate(table.figures):
        for block in dict.fromkeys(row.block for row in table.rows):
            for index, mark in _rank(table, block, column, figure).items():
                result[index][column] = mark
    return result


def _rank(table: Table, block: str, column: int, figure: str) -> dict[int, Mark]:
    kind, left = kind_of(figure), dict[int, tuple[float, float]]()
    for index, row in enumerate(table.rows):
        mean, std, *_ = row.cells[column]
        if row.block == block and not row.published and mean is not None:
            left[index] = round(mean, kind.decimals), std or 0.0
    if kind.better is None or len(left) < 2:
        return {}
    best_of, ranked = max if kind.better == "higher" else min, dict[int, Mark]()
    for mark in get_args(Mark)[:2]:
        best, spread = best_of(left.values(), default=(math.nan, 0.0))
        for index, (mean, _) in [*left.items()]:
            if round(abs(mean - best), kind.decimals) <= spread:
                ranked[index] = mark
                del left[index]
    return ranked


def to_markdown(table: Table) -> str:
    """The table with marks, footnotes for its dashes, and remarks."""
    notes = _Notes()
    blocks = [f"**{escape_markdown(table.caption)}**"]
    for part in _parts(table, MARKDOWN_GROUPS):
        escaped = (each._replace(heading=escape_markdown(each.heading)) for each in part.groups)
        columns = _headings(replace(part, groups=tuple(escaped)), "<br>")
        headings = [*map(escape_markdown, part.label_headings), *columns]
        lines = [
            _pipe(headings),
            "|" + "---|" * len(part.label_headings) + "---:|" * len(part.figures),
        ]
        for labels, cells in _cells(part, notes):
            shown = []
            for text, mark, note in cells:
                marked = {"best": f"**{text}**", "second": f"<u>{text}</u>", "": text}[mark]
                shown.append(f"{marked}<sup>{note}</sup>" if note else marked)
            lines.append(_pipe([*map(escape_markdown, labels), *shown]))
        blocks.append("\n".join(lines))
    footnotes = [
        f"<sup>{letter}</sup> {escape_markdown(text)}." for letter, text in notes.lettered()
    ]
    blocks.append("<br>\n".join([LEGEND, *map(escape_markdown, table.remarks), *footnotes]))
    return "\n\n".join(blocks) + "\n"


def to_latex(table: Table) -> str:
    """A ``table*`` for ``booktabs``, ``graphicx`` and ``amssymb``, with marks and footnotes."""
    notes = _Notes()
    lines = [r"\begin{table*}[t]", r"\centering"]
    for part in _parts(table, LATEX_GROUPS):
        lines += [r"\resizebox{\textwidth}{!}{%", *_tabular(part, notes), "}"]
    footnotes = [f"$^{{{letter}}}$ {_escape_latex(text)}." for letter, text in notes.lettered()]
    below = " ".join([*map(_escape_latex, [LEGEND, *table.remarks]), *footnotes])
    lines += [
        rf"\par\smallskip\footnotesize {below}",
        rf"\caption{{{_escape_latex(table.caption)}}}",
        rf"\label{{tab:{table.name}}}",
        r"\end{table*}",
    ]
    return "\n".join(lines) + "\n"


def to_csv(table: Table) -> str:
    """One line per figure, with all decimals: the labels, group, figure, unit, mean, std, seeds,
    mark, note. Names and notes that a spreadsheet would run as formulas are quoted."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    fields = ("group", "figure", "unit", "mean", "std", "seeds", "mark", "note")
    writer.writerow([*(heading or "method" for heading in table.label_headings), *fields])
    columns = [(group.heading, name) for group in table.groups for name in group.figures]
    for row, row_marks in zip(table.rows, marks(table), strict=True):
        for (group, name), cell, mark in zip(columns, row.cells, row_marks, strict=True):
            mean, std = ("" if value is None else repr(value) for value in (cell.mean, cell.std))
            kind = kind_of(name)
            names = map(escape_cell, [*row.labels, group])
            figure = kind.heading, kind.unit, mean, std, cell.seeds or "", mark
            writer.writerow([*names, *figure, escape_cell(cell.note or "")])
    return text.getvalue()


def to_plain(table: Table) -> str:
    """The table for a terminal, scene by scene, without notes; * marks the best, + the second."""
    signs: dict[Mark, str] = {"best": "*", "second": "+", "": " "}
    lines = [table.caption]
    for part in _parts(table, 1):
        plain = replace(part, groups=(part.groups[0]._replace(heading=""),))
        rows = [[*part.label_headings, *_headings(plain, "")]]
        rows += [
            [*labels, *(text + signs[mark] for text, mark, _ in cells)]
            for labels, cells in _cells(part, _Notes())
        ]
        lines += [f"\n{part.groups[0].heading}"] if part.groups[0].heading else [""]
        lines += aligned(rows, range(len(part.label_headings)))
    return "\n".join(lines) + "\n"


class _Notes:
    """Letters for the notes of a table; equal notes share one."""

    def __init__(self) -> None:
        self._texts: list[str] = []

    def letter(self, text: str | None) -> str:
        if text is None:
            return ""
        if text not in self._texts:
            self._texts.append(text)
        return self._name(self._texts.index(text))

    def lettered(self) -> list[tuple[str, str]]:
        return [(self._name(index), text) for index, text in enumerate(self._texts)]

    @staticmethod
    def _name(index: int) -> str:
        """a to z, then aa, ab, ..."""
        rounds, place = divmod(index, len(ascii_lowercase))
        return (ascii_lowercase[rounds - 1] if rounds else "") + ascii_lowercase[place]


def _parts(table: Table, most: int) -> Iterator[Table]:
    """The table cut into tables of at most ``most`` groups; marks go by column, and stay."""
    start = 0
    for first in range(0, len(table.groups), most):
        groups = table.groups[first : first + most]
        end = start + sum(len(group.figures) for group in groups)
        rows = tuple(replace(row, cells=row.cells[start:end]) for row in table.rows)
        yield replace(table, groups=groups, rows=rows)
        start = end


def _cells(
    table: Table, notes: _Notes
) -> Iterator[tuple[tuple[str, ...], list[tuple[str, Mark, str]]]]:
    """Per row: its labels, and each cell's text, mark and note letter."""
    for row, row_marks in zip(table.rows, marks(table), strict=True):
        cells = [
            (printed(cell, name, row.published), mark, notes.letter(cell.note))
            for cell, name, mark in zip(row.cells, table.figures, row_marks, strict=True)
        ]
        yield row.labels, cells


def _headings(table: Table, line_break: str) -> list[str]:
    arrows = {"higher": " ↑", "lower": " ↓", None: ""}
    headings = []
    for group in table.groups:
        for name in group.figures:
            kind = kind_of(name)
            text = kind.heading + (f", {kind.unit}" if kind.unit else "") + arrows[kind.better]
            headings.append(f"{group.heading}{line_break}{text}" if group.heading else text)
    return headings


def _pipe(fields: Sequence[str]) -> str:
    return "| " + " | ".join(fields) + " |"


def _tabular(table: Table, notes: _Notes) -> list[str]:
    labels = len(table.label_headings)
    lines = [rf"\begin{{tabular}}{{{'l' * labels}{'r' * len(table.figures)}}}", r"\toprule"]
    headings = [(len(group.figures), _escape_latex(group.heading)) for group in table.groups]
    if any(heading for _, heading in headings):
        spans = [rf"\multicolumn{{{n}}}{{c}}{{\textit{{{heading}}}}}" for n, heading in headings]
        lines.append(" & ".join([""] * labels + spans) + r" \\")
    plain = replace(table, groups=tuple(group._replace(heading="") for group in table.groups))
    columns = [*table.label_headings, *_headings(plain, " ")]
    lines.append(" & ".join(map(_escape_latex, columns)) + r" \\")
    block = None
    for row, (row_labels, cells) in zip(table.rows, _cells(table, notes), strict=True):
        if row.block != block:
            lines.append(r"\midrule")
            block = row.block
        shown = []
        for plain_text, mark, note in cells:
            text = _escape_latex(plain_text)
            commands = {"best": rf"\textbf{{{text}}}", "second": rf"\underline{{{text}}}", "": text}
            shown.append(f"{commands[mark]}$^{{{note}}}$" if note else commands[mark])
        lines.append(" & ".join([*map(_escape_latex, row_labels), *shown]) + r" \\")
    return [*lines, r"\bottomrule", r"\end{tabular}"]


def _escape_latex(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in text)
