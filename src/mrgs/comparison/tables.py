"""The tables of the paper's experiments, from the outcomes of runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from mrgs.comparison import paper
from mrgs.comparison.results import Cell, Outcome, kind_of, over_scenes, over_seeds
from mrgs.comparison.table import Group, Row, Table
from mrgs.evaluation.figures import REPORTED, Figure, Missing
from mrgs.pictures.values import capitalised
from mrgs.scene import THERMAL

NAMES = (*(modality.name for modality in REPORTED), "ablation", "neighbours", "truth", "aligned")
"""Names of all possible tables; that of another modality has the modality's name."""

CELSIUS = ("thermal.psnr", "thermal.ssim", "thermal.mae_c", "gaussians_k")
WITHOUT_CELSIUS = ("thermal.psnr", "thermal.psnr_matched", "thermal.ssim", "gaussians_k")
NEIGHBOURS = (*CELSIUS, "minutes")
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

MEAN = "mean"
MATCHED = (
    "PSNR matched, for scenes without °C: after the rendering took the gain and the offset "
    "that suit the photo best."
)
PUBLISHED = (
    "Rows marked (paper) are the paper's own figures, on other hardware and a longer "
    "schedule; they are not ranked."
)


@dataclass(frozen=True)
class Outcomes:
    """All outcomes of a comparison, by scene and method.

    Attributes:
        all: in any order.
        scenes: names in the order of the columns.
        methods: in the order of the rows, without those of the table of neighbours alone.
        neighbours: the method of each n of the table of neighbours.
    """

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
        """The mean over the scenes where any method has the figure.

        Args:
            among: only of these scenes; None for all.
        """
        among = self.scenes if among is None else among
        scenes = [scene for scene in self.scenes_with(figure) if scene in among] or among
        return over_scenes([self.figures(scene, method, figure) for scene in scenes], scenes)

    def scenes_with(self, figure: str) -> list[str]:
        """The scenes where at least one method has the figure."""
        return [
            scene
            for scene in self.scenes
            if any(
                isinstance(value, float)
                for method in self.methods
                for value in self.figures(scene, method, figure)
            )
        ]


def all_tables(outcomes: Outcomes) -> list[Table]:
    """All tables that have contents."""
    tables = []
    if outcomes.methods:
        caption = "novel views of scenes and methods: held-out views, full frame."
        for modality, title in _scored(outcomes).items():
            figures_of = partial(_figures_of, outcomes, modality)
            tables.append(_methods_by_scenes(outcomes, modality, f"{title} {caption}", figures_of))
    if sum(method in ABLATION for method in outcomes.methods) > 1:
        tables.append(_ablation(outcomes))
    if outcomes.neighbours:
        tables.append(_neighbours(outcomes))
    if with_truth := _scenes_with_any(outcomes, TRUTH):
        tables.append(_truth(outcomes, with_truth))
    if with_aligned := _scenes_with_any(outcomes, ALIGNED[1:]):
        tables.append(_aligned(outcomes, with_aligned))
    return tables


def _scenes_with_any(outcomes: Outcomes, figures: Sequence[str]) -> tuple[str, ...]:
    """The scenes where at least one method has one of the figures."""
    found = {scene for figure in figures for scene in outcomes.scenes_with(figure)}
    return tuple(scene for scene in outcomes.scenes if scene in found)


def _scored(outcomes: Outcomes) -> dict[str, str]:
    """Names and titles of the tables' modalities: ``REPORTED``, and what else any scene has."""
    titles = {modality.name: capitalised(modality.title) for modality in REPORTED}
    others = {name for each in outcomes.all for name in each.modalities} - titles.keys()
    return titles | {name: name for name in sorted(others)}


def _figures_of(outcomes: Outcomes, modality: str, scenes: Sequence[str]) -> tuple[str, ...]:
    """What the images of scenes are judged by: the paper's figures, or what takes the place of the
    MAE."""
    if modality != THERMAL.name:
        return (*(f"{modality}.{key}" for key in ("psnr", "ssim", "lpips")), "gaussians_k")
    celsius, matched = (
        set(outcomes.scenes_with(key)) for key in ("thermal.mae_c", "thermal.psnr_matched")
    )
    if celsius.intersection(scenes) or not matched.intersection(scenes):
        return CELSIUS
    return WITHOUT_CELSIUS


def _methods_by_scenes(
    outcomes: Outcomes,
    name: str,
    caption: str,
    figures_of: Callable[[Sequence[str]], tuple[str, ...]],
) -> Table:
    """A row per method and a group of columns per scene, as the paper's Tables 1 and 2.

    ``figures_of`` gives the figures below a scene and, given all scenes, below the mean.
    """
    groups = [Group(_title(scene), figures_of((scene,))) for scene in outcomes.scenes]
    columns = [(scene, key) for scene in outcomes.scenes for key in figures_of((scene,))]
    means = figures_of(outcomes.scenes) if len(outcomes.scenes) > 1 else ()
    rows = []
    for method in outcomes.methods:
        cells = [over_seeds(outcomes.figures(scene, method, key)) for scene, key in columns]
        cells += [outcomes.mean(method, key) for key in means]
        rows.append(Row((method,), tuple(cells)))
    remarks = [MATCHED] if any(key == "thermal.psnr_matched" for _, key in columns) else []
    remarks += _remarks_on_means(outcomes, outcomes.scenes, means)
    if any(paper.rows_of(name, scene) for scene in outcomes.scenes):
        for row in paper.METHODS:
            cells = [paper.cell(name, scene, row, key) for scene, key in columns]
            cells += [paper.mean_cell(name, outcomes.scenes, row, key) for key in means]
            rows.append(Row((f"{row} (paper)",), tuple(cells), published=True))
        remarks.append(PUBLISHED)
    groups += [Group(MEAN, means)] if means else []
    return Table(name, caption, ("",), tuple(groups), tuple(rows), tuple(remarks))


def _ablation(outcomes: Outcomes) -> Table:
    """A block of rows per scene, as the paper's Table 3."""
    methods = [method for method in ABLATION if method in outcomes.methods]
    rows = []
    for scene in outcomes.scenes:
        for method in methods:
            cells = tuple(over_seeds(outcomes.figures(scene, method, key)) for key in CELSIUS)
            rows.append(Row((_title(scene), *ABLATION[method]), cells, block=scene))
        rows += _published_rows("ablation", scene, CELSIUS, ABLATION)
    remarks = [PUBLISHED] if any(row.published for row in rows) else []
    if len(outcomes.scenes) > 1:
        for method in methods:
            cells = tuple(outcomes.mean(method, key) for key in CELSIUS)
            rows.append(Row((MEAN, *ABLATION[method]), cells, block=MEAN))
        remarks += _remarks_on_means(outcomes, outcomes.scenes, CELSIUS)
    return Table(
        "ablation",
        "Ablation of the paper's parts: thermal images of held-out views.",
        ("scene", "3DGS_RGB-T", "MrGS base", "Fourier", "L_boltz"),
        (Group("", CELSIUS),),
        tuple(rows),
        tuple(remarks),
    )


def _neighbours(outcomes: Outcomes) -> Table:
    """A row per n, as the paper's Table 4."""
    rows = []
    for scene in outcomes.scenes:
        for n, method in sorted(outcomes.neighbours.items()):
            cells = tuple(over_seeds(outcomes.figures(scene, method, key)) for key in NEIGHBOURS)
            rows.append(Row((_title(scene), f"n = {n}"), cells, block=scene))
        labels = {str(n): (f"n = {n}",) for n in sorted(outcomes.neighbours)}
        rows += _published_rows("neighbours", scene, NEIGHBOURS, labels)
    remarks = [
        "Each Gaussian exchanges heat with K = n² − 1 neighbours.",
        "The time is that of the training alone.",
    ]
    if any(row.published for row in rows):
        remarks.append(PUBLISHED)
    return Table(
        "neighbours",
        "The number of neighbours in the Fourier heat transformation: thermal images of held-out "
        "views.",
        ("scene", "neighbours"),
        (Group("", NEIGHBOURS),),
        tuple(rows),
        tuple(remarks),
    )


def _truth(outcomes: Outcomes, scenes: tuple[str, ...]) -> Table:
    """Errors against exact temperatures and depths, where a scene has them."""
    remarks = [
        "MAE to exact: of the rendered view, mean over the frame.",
        "Camera's own MAE: of the camera's image of the same view.",
        "Ratio: the first over the second; below 1, the model is a better thermometer than the "
        "camera.",
        "Depth error: median of |rendered − exact| / exact over a view, mean over the views.",
    ]
    caption = "Against exact temperatures and depths, of scenes that have them."
    return _same_figures(outcomes, scenes, "truth", caption, TRUTH, remarks)


def _aligned(outcomes: Outcomes, scenes: tuple[str, ...]) -> Table:
    """Scores with each held-out photo aligned with the model, of scenes whose poses are wrong."""
    remarks = [
        "Pose error: how far off what the model shows a typical held-out photo is at the "
        "pose as given.",
        "A dash: the photos fit the model at the poses as given, the model cannot tell, or the "
        "scene does not have the figure.",
    ]
    caption = (
        "Scores after aligning each held-out photo with the model, for scenes whose poses seem "
        "wrong: at a wrong pose a sharp model scores no better than a blurred one."
    )
    figures = [figure for figure in ALIGNED if outcomes.scenes_with(figure)]
    return _same_figures(outcomes, scenes, "aligned", caption, tuple(figures), remarks)


def _same_figures(
    outcomes: Outcomes,
    scenes: tuple[str, ...],
    name: str,
    caption: str,
    figures: tuple[str, ...],
    remarks: Sequence[str],
) -> Table:
    """A row per method, and the same columns below each scene and the mean."""
    several = len(scenes) > 1
    rows = []
    for method in outcomes.methods:
        cells = [
            over_seeds(outcomes.figures(scene, method, key)) for scene in scenes for key in figures
        ]
        cells += [outcomes.mean(method, key, scenes) for key in figures] if several else []
        rows.append(Row((method,), tuple(cells)))
    groups = [Group(_title(scene), figures) for scene in scenes]
    groups += [Group(MEAN, figures)] if several else []
    remarks = [*remarks, *(_remarks_on_means(outcomes, scenes, figures) if several else [])]
    return Table(name, caption, ("",), tuple(groups), tuple(rows), tuple(remarks))


def _published_rows(
    table: str, scene: str, figures: Sequence[str], labels: Mapping[str, tuple[str, ...]]
) -> list[Row]:
    """The paper's rows for a scene, where it has them."""
    return [
        Row(
            (f"{_title(scene)} (paper)", *labels[row]),
            tuple(paper.cell(table, scene, row, key) for key in figures),
            block=scene,
            published=True,
        )
        for row in labels
        if row in paper.rows_of(table, scene)
    ]


def _remarks_on_means(
    outcomes: Outcomes, scenes: Sequence[str], figures: Sequence[str]
) -> list[str]:
    """Which means leave some of a table's scenes out, because no method has the figure there."""
    remarks = []
    for figure in figures:
        there = outcomes.scenes_with(figure)
        gone = [_title(scene) for scene in scenes if scene not in there]
        if there and gone:
            remarks.append(
                f"The mean {kind_of(figure).heading} leaves out {', '.join(gone)}, which has none."
            )
    return remarks


def _title(scene: str) -> str:
    """The paper's name of a scene, or the folder's."""
    return paper.scene_title(scene) or scene
