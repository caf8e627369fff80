"""The tables of the paper's experiments: the outcomes of runs, beside what the paper published."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib.resources import files
from typing import Any

from mrgs.evaluation.metrics import REPORTED, Figure, Missing
from mrgs.pictures.values import capitalised
from mrgs.scene import THERMAL
from mrgs_compare.table import Cell, Group, Outcome, Row, Table, kind_of, over_scenes, over_seeds

NAMES = (*(modality.name for modality in REPORTED), "ablation", "neighbours", "truth", "aligned")
"""Names of all possible tables; that of another modality has the modality's name."""

CELSIUS = ("thermal.psnr", "thermal.ssim", "thermal.mae_c", "gaussians_k")
WITHOUT_CELSIUS = ("thermal.psnr", "thermal.psnr_matched", "thermal.ssim", "gaussians_k")
NEIGHBOURS = (*CELSIUS, "minutes")
IMAGES = ("psnr", "ssim", "lpips")
TRUTH = ("truth.mae_c", "truth.camera_mae_c", "truth.ratio", "truth.depth_percent")
ALIGNED = (
    "poses.error_px",
    "poses.aligned.thermal.psnr",
    "poses.aligned.rgb.psnr",
    "poses.aligned.thermal.mae_c",
    "poses.aligned.truth.mae_c",
)

ABLATION = {
    "3dgs-rgbt": ("✓", "", "", ""),
    "mrgs-base": ("", "✓", "", ""),
    "mrgs-fourier": ("", "✓", "✓", ""),
    "mrgs-boltz": ("", "✓", "", "✓"),
    "mrgs": ("", "✓", "✓", "✓"),
}
"""What each method has, in the columns of the paper's Table 3."""

PAPER_METHODS = ("ThermoNeRF", "3DGS_RGB-T", "MrGS")
"""Rows of the paper's tables of thermal and RGB images."""

MEAN = "mean"
MATCHED = (
    "PSNR matched, for scenes without °C: after the rendering took the gain and the offset "
    "that suit the photo best."
)
PUBLISHED = (
    "Rows marked (paper) are the paper's own figures, on other hardware and a longer "
    "schedule; they are not ranked."
)

TRUTH_REMARKS = (
    "MAE to exact: of the rendered view, mean over the frame.",
    "Camera's own MAE: of the camera's image of the same view.",
    "Ratio: the first over the second; below 1, the model is a better thermometer than the camera.",
    "Depth error: median of |rendered − exact| / exact over a view, mean over the views.",
)
ALIGNED_REMARKS = (
    "Pose error: how far off what the model shows a typical held-out photo is at the pose as "
    "given.",
    "A dash: the photos fit the model at the poses as given, the model cannot tell, or the scene "
    "does not have the figure.",
)


@dataclass(frozen=True)
class Outcomes:
    """All outcomes of a comparison, by scene and method: scenes in the order of the columns,
    methods in that of the rows, without methods that occur only in the table of neighbours;
    ``neighbours`` maps each n to its method."""

    all: tuple[Outcome, ...]
    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    neighbours: dict[int, str]

    def figures(self, scene: str, method: str, figure: str) -> list[Figure]:
        """The figure of one method on one scene, for each seed."""
        found = [each for each in self.all if (each.scene, each.method) == (scene, method)]
        return [
            each.figures.get(figure, Missing(each.failure or "not scored")) for each in found
        ] or [Missing("not run")]

    def mean(self, method: str, figure: str, among: Sequence[str] | None = None) -> Cell:
        """The mean over the scenes, by default all, where any method has the figure."""
        among = self.scenes if among is None else among
        scenes = [scene for scene in self.scenes_with(figure) if scene in among] or among
        return over_scenes([self.figures(scene, method, figure) for scene in scenes], scenes)

    def scenes_with(self, *figures: str) -> list[str]:
        """The scenes where at least one method has one of the figures."""
        return [
            scene
            for scene in self.scenes
            if any(
                isinstance(value, float)
                for method in self.methods
                for figure in figures
                for value in self.figures(scene, method, figure)
            )
        ]


@cache
def published() -> dict[str, Any]:
    """``paper.json``: figures by table, the paper's name of the scene, row and figure. ``scenes``
    maps ThermoScenes' folder names to the paper's; rows of the ablation have this program's method
    names, rows of ``neighbours`` the paper's n."""
    text = files("mrgs_compare").joinpath("paper.json").read_text(encoding="utf-8")
    content: dict[str, Any] = json.loads(text)
    return content


def scene_title(scene: str) -> str:
    """The paper's name of a ThermoScenes scene; the folder's name for other scenes."""
    return str(published()["scenes"].get(scene, scene))


def published_rows(table: str, scene: str) -> dict[str, dict[str, float | None]]:
    """The paper's rows of a table for a scene; empty if it has none."""
    rows: dict[str, dict[str, float | None]] = published().get(table, {}).get(scene_title(scene))
    return rows or {}


def published_figure(table: str, row: str, figure: str, scene: str) -> Figure:
    """A figure of the paper, by its key (one of ``table.figure_keys``)."""
    figures = published_rows(table, scene).get(row)
    if figures is None:
        return Missing("the paper has no figures of this scene")
    value = figures.get(figure.rpartition(".")[2])
    return Missing("the paper does not say") if value is None else float(value)


def _published_cell(table: str, row: str, figure: str, scene: str) -> Cell:
    value = published_figure(table, row, figure, scene)
    return Cell(None, note=value.reason) if isinstance(value, Missing) else Cell(value)


def all_tables(outcomes: Outcomes, setup: str = "") -> list[Table]:
    """All tables that have contents; the setup of their runs ends each caption."""
    tables = []
    if outcomes.methods:
        caption = "novel views of scenes and methods: held-out views, full frame."
        titles = {modality.name: capitalised(modality.title) for modality in REPORTED}
        others = {name for each in outcomes.all for name in each.modalities} - titles.keys()
        for modality, title in (titles | {name: name for name in sorted(others)}).items():
            figures_of = partial(_figures_of, outcomes, modality)
            tables.append(_by_scene(outcomes, modality, f"{title} {caption}", figures_of))
    if sum(method in ABLATION for method in outcomes.methods) > 1:
        tables.append(_ablation(outcomes))
    if outcomes.neighbours:
        tables.append(_neighbours(outcomes))
    if with_truth := tuple(outcomes.scenes_with(*TRUTH)):
        caption = "Against exact temperatures and depths, of scenes that have them."
        tables.append(
            _by_scene(outcomes, "truth", caption, lambda _: TRUTH, with_truth, TRUTH_REMARKS)
        )
    if with_aligned := tuple(outcomes.scenes_with(*ALIGNED[1:])):
        figures = tuple(figure for figure in ALIGNED if outcomes.scenes_with(figure))
        caption = (
            "Scores after aligning each held-out photo with the model, for scenes whose poses seem "
            "wrong: at a wrong pose a sharp model scores no better than a blurred one."
        )
        tables.append(
            _by_scene(
                outcomes, "aligned", caption, lambda _: figures, with_aligned, ALIGNED_REMARKS
            )
        )
    return [replace(table, caption=f"{table.caption} {setup}".strip()) for table in tables]


def _figures_of(outcomes: Outcomes, modality: str, scenes: Sequence[str]) -> tuple[str, ...]:
    """The paper's figures of a modality's images; without °C, PSNR matched in place of the MAE."""
    if modality != THERMAL.name:
        return (*(f"{modality}.{key}" for key in IMAGES), "gaussians_k")
    celsius, matched = (
        set(outcomes.scenes_with(key)) for key in ("thermal.mae_c", "thermal.psnr_matched")
    )
    if celsius.intersection(scenes) or not matched.intersection(scenes):
        return CELSIUS
    return WITHOUT_CELSIUS


def _by_scene(
    outcomes: Outcomes,
    name: str,
    caption: str,
    figures_of: Callable[[Sequence[str]], tuple[str, ...]],
    scenes: tuple[str, ...] | None = None,
    remarks: Sequence[str] = (),
) -> Table:
    """A row per method and a group of columns per scene, as the paper's Tables 1 and 2."""
    scenes = outcomes.scenes if scenes is None else scenes
    columns = [(scene, key) for scene in scenes for key in figures_of((scene,))]
    means = figures_of(scenes) if len(scenes) > 1 else ()
    rows = []
    for method in outcomes.methods:
        cells = [over_seeds(outcomes.figures(scene, method, key)) for scene, key in columns]
        cells += [outcomes.mean(method, key, scenes) for key in means]
        rows.append(Row((method,), tuple(cells)))
    matched = [MATCHED] if any(key == "thermal.psnr_matched" for _, key in columns) else []
    remarks = [*remarks, *matched, *_remarks_on_means(outcomes, scenes, means)]
    if any(published_rows(name, scene) for scene in scenes):
        for row in PAPER_METHODS:
            cells = [_published_cell(name, row, key, scene) for scene, key in columns]
            for key in means:
                found = [[published_figure(name, row, key, scene)] for scene in scenes]
                cells.append(over_scenes(found, scenes))
            rows.append(Row((f"{row} (paper)",), tuple(cells), published=True))
        remarks.append(PUBLISHED)
    groups = [Group(scene_title(scene), figures_of((scene,))) for scene in scenes]
    groups += [Group(MEAN, means)] if means else []
    return Table(name, caption, ("",), tuple(groups), tuple(rows), tuple(remarks))


def _ablation(outcomes: Outcomes) -> Table:
    """A block of rows per scene, as the paper's Table 3."""
    labels = {method: ABLATION[method] for method in ABLATION if method in outcomes.methods}
    rows, remarks = _blocks(outcomes, "ablation", CELSIUS, labels, ABLATION)
    if len(outcomes.scenes) > 1:
        for method, label in labels.items():
            cells = tuple(outcomes.mean(method, key) for key in CELSIUS)
            rows.append(Row((MEAN, *label), cells, block=MEAN))
        remarks += _remarks_on_means(outcomes, outcomes.scenes, CELSIUS)
    caption = "Ablation of the paper's parts: thermal images of held-out views."
    headings = ("scene", "3DGS_RGB-T", "MrGS base", "Fourier", "L_boltz")
    groups = (Group("", CELSIUS),)
    return Table("ablation", caption, headings, groups, tuple(rows), tuple(remarks))


def _neighbours(outcomes: Outcomes) -> Table:
    """A row per n, as the paper's Table 4."""
    methods = {n: outcomes.neighbours[n] for n in sorted(outcomes.neighbours)}
    labels = {method: (f"n = {n}",) for n, method in methods.items()}
    paper_labels = {str(n): (f"n = {n}",) for n in methods}
    rows, remarks = _blocks(outcomes, "neighbours", NEIGHBOURS, labels, paper_labels)
    remarks = [
        "Each Gaussian exchanges heat with K = n² − 1 neighbours.",
        "The time is that of the training alone.",
        *remarks,
    ]
    caption = (
        "The number of neighbours in the Fourier heat transformation: thermal images of held-out "
        "views."
    )
    headings, groups = ("scene", "neighbours"), (Group("", NEIGHBOURS),)
    return Table("neighbours", caption, headings, groups, tuple(rows), tuple(remarks))


def _blocks(
    outcomes: Outcomes,
    table: str,
    figures: Sequence[str],
    labels: Mapping[str, tuple[str, ...]],
    paper_labels: Mapping[str, tuple[str, ...]],
) -> tuple[list[Row], list[str]]:
    """Per scene a row for each labelled method, and the paper's if it has any, with a remark."""
    rows = []
    for scene in outcomes.scenes:
        title = scene_title(scene)
        for method, label in labels.items():
            cells = [over_seeds(outcomes.figures(scene, method, key)) for key in figures]
            rows.append(Row((title, *label), tuple(cells), block=scene))
        for row in paper_labels:
            if row in published_rows(table, scene):
                cells = [_published_cell(table, row, key, scene) for key in figures]
                label = (f"{title} (paper)", *paper_labels[row])
                rows.append(Row(label, tuple(cells), block=scene, published=True))
    return rows, [PUBLISHED] if any(row.published for row in rows) else []


def _remarks_on_means(
    outcomes: Outcomes, scenes: Sequence[str], figures: Sequence[str]
) -> list[str]:
    """Which means leave out some of a table's scenes because no method has the figure there."""
    remarks = []
    for figure in figures:
        there = outcomes.scenes_with(figure)
        gone = [scene_title(scene) for scene in scenes if scene not in there]
        if there and gone:
            remarks.append(
                f"The mean {kind_of(figure).heading} leaves out {', '.join(gone)}, which has none."
            )
    return remarks
