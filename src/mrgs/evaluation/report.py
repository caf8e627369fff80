"""``metrics.json`` and ``metrics.md``."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

from mrgs.evaluation.evaluate import NO_CELSIUS, TRUTH_FIGURES, Metrics, Parts
from mrgs.evaluation.metrics import Figure, Figures, Missing, figure_names, to_json
from mrgs.pictures.escape import escape_markdown
from mrgs.pictures.values import capitalised
from mrgs.run_files.facts import ImageFingerprint, changes, fingerprints
from mrgs.scene import Modality, Scene
from mrgs.system.atomic import write_text
from mrgs.system.typed_json import from_json

COLUMNS = {
    "psnr": ("PSNR, dB", 2),
    "psnr_matched": ("PSNR matched, dB", 2),
    "ssim": ("SSIM", 4),
    "ssim_pair_range": ("SSIM, pair range", 4),
    "mae_c": ("MAE, °C", 3),
    "mae_offset_c": ("MAE after offset, °C", 3),
    "mae_foreground_c": ("MAE foreground, °C", 3),
    "lpips": ("LPIPS", 4),
    "camera_mae_c": ("the camera's own MAE, °C", 3),
    "depth_median_relative_error": ("median relative depth error", 4),
}
"""Heading and decimals of each figure."""

CONVENTIONS = (
    "Full frame, undistorted images, mean over the views. PSNR has the range 1; 'matched' gives "
    "each channel of the rendering the gain and the offset that suit the photo best, for cameras "
    "that expose or scale every photo by itself; 'after offset' gives the temperatures the offset "
    "that suits the photo best, for cameras that drift. SSIM uses an 11×11 Gaussian window (σ 1.5) "
    "with the data range 1, as the 3DGS family does; 'pair range' takes the range of the image "
    "pair and whole windows only, as torchmetrics does by default up to 1.4.1. The foreground is "
    "the side of Otsu's threshold (averaged over the views) that covers less of the images' "
    "borders. LPIPS is VGG's on [-1, 1]; the 3DGS family feeds it [0, 1], so its numbers do not "
    "compare."
)

NO_POSE_ERROR = (
    "too few held-out views, or the model is not clear enough to tell, or the images are another "
    "program's"
)

UNKNOWN_FACTS = {
    "steps": "not known: the images are another program's",
    "gaussians": "the method has no Gaussians, or the images are another program's",
    "train_seconds": "not measured during the training",
    "peak_memory_bytes": "not measured during the training",
}
"""Why a fact about a run can be None."""


@dataclass(frozen=True)
class ScoredData:
    """The data of a run that was scored, on which scores depend besides the model: each held-out
    image, view by view; a digest of the photos that it was trained on, empty where its checkpoint
    does not name them; and the °C of the scene's values 0 and 1, None without known °C."""

    held_out: tuple[ImageFingerprint, ...]
    training_photos: str = ""
    temperature_c: tuple[float, float] | None = None

    @classmethod
    def of(cls, scene: Scene, trained: Sequence[ImageFingerprint]) -> ScoredData:
        """The data of a scene's scores. SceneError if a photo cannot be read."""
        photos = "".join(image.photo for image in trained)
        digest = hashlib.sha256(photos.encode()).hexdigest() if photos else ""
        bounds = None if scene.temperature is None else astuple(scene.temperature)
        return cls(fingerprints(_held_out(scene)), digest, bounds)

    def to_json(self) -> dict[str, Any]:
        """The object for ``metrics.json``; what is not known has no entry."""
        return {"held_out": self.held_out} | {name: v for name, v in vars(self).items() if v}

    @classmethod
    def from_json(cls, value: Any) -> ScoredData | None:
        """The data from their JSON form; None for anything else, as in older files."""
        try:
            return from_json(cls, value)
        except ValueError:
            return None

    def changes(self, now: ScoredData, scene: Scene) -> str:
        """What has changed since the scores were computed, for the user; empty if nothing has."""
        if self.temperature_c != now.temperature_c:
            return "it has another temperature range"
        if self.training_photos and self.training_photos != now.training_photos:
            return "training photos"
        if len(self.held_out) != len(now.held_out):
            return f"it has {len(now.held_out)} held-out images, not {len(self.held_out)}"
        return changes(self.held_out, now.held_out, _held_out(scene)) if self.held_out else ""


def _held_out(scene: Scene) -> Scene:
    """The scene's held-out views in the place of those to learn from."""
    return replace(scene, train=scene.eval)


@dataclass(frozen=True)
class RunFacts:
    """Facts about a run and its cost; None where a value was not measured.

    Attributes:
        method: name of the method, such as ``mrgs`` or ``3dgs-rgbt``.
        steps: training steps taken; None for another program's images.
        gaussians: how many Gaussians the model has; None if it has none, or for another program's
            images.
        train_seconds: wall-clock time of the training, s.
        device: ``cpu`` or the GPU's name.
        custom_parts: what it was trained with besides its configuration, see ``RunFolder``.
    """

    method: str
    scene: str
    steps: int | None = None
    gaussians: int | None = None
    train_seconds: float | None = None
    peak_memory_bytes: int | None = None
    device: str = "not known"
    custom_parts: Sequence[str] = ()


def to_document(
    facts: RunFacts, metrics: Metrics, parts: Parts | None = None, data: ScoredData | None = None
) -> dict[str, Any]:
    """The content of ``metrics.json``.

    Every null has its sentence under ``reasons``, keyed by the figure's dotted path inside the
    object that holds ``reasons``: the document itself for the run and the means, each entry of
    ``views`` for its own figures.
    """
    document: dict[str, Any] = dict(vars(facts))
    reasons = {name: UNKNOWN_FACTS[name] for name, value in document.items() if value is None}
    document["mean"] = {
        modality.name: _split(figures, f"mean.{modality}", reasons)
        for modality, figures in metrics.mean.items()
    }
    if metrics.truth is not None:
        document["truth"] = _split(metrics.truth, "truth", reasons)
    if parts is not None:
        document["parts"] = _parts_document(parts, reasons)
    if metrics.pose_error_px is None:
        reasons["poses.error_px"] = NO_POSE_ERROR
    document["poses"] = {"error_px": metrics.pose_error_px}
    if (aligned := metrics.aligned) is not None:
        found = _groups(aligned.mean, aligned.truth, "poses.aligned.", reasons)
        document["poses"]["aligned"] = found
    document["reasons"] = reasons
    document["views"] = []
    for view in metrics.views:
        own: dict[str, str] = {}
        entry = _groups(view.figures, view.truth, "", own)
        document["views"].append({"name": view.name, **entry, "reasons": own})
    if data is not None:
        document["data"] = data.to_json()
    return document


def _parts_document(parts: Parts, reasons: dict[str, str]) -> dict[str, Any]:
    spreads = parts.spreads.to_json(parts.temperature)
    reasons |= {f"parts.{name}": NO_CELSIUS for name, value in spreads.items() if value is None}
    knocked_out = {
        part: _split(figures, f"parts.knock_out.{part}", reasons)
        for part, figures in parts.knock_out.items()
    }
    return {**spreads, "knock_out": knocked_out}


def _groups(
    figures: Mapping[Modality, Figures], truth: Figures | None, prefix: str, reasons: dict[str, str]
) -> dict[str, dict[str, float | None]]:
    """The figures of each modality, and against the exact truth where there is one."""
    groups = {modality.name: own for modality, own in figures.items()}
    groups |= {} if truth is None else {"truth": truth}
    return {name: _split(own, f"{prefix}{name}", reasons) for name, own in groups.items()}


def to_markdown(facts: RunFacts, metrics: Metrics, parts: Parts | None = None) -> str:
    """The content of ``metrics.md``: the figures as tables; a dash for a missing one, with the
    reasons at the end."""
    seconds, memory = facts.train_seconds, facts.peak_memory_bytes
    counts = {"steps": facts.steps, "Gaussians": facts.gaussians}
    cost = [f"{number:,} {noun}" for noun, number in counts.items() if number is not None]
    cost += [
        "training " + ("not measured" if seconds is None else f"{seconds:.0f} s"),
        "peak memory " + ("not measured" if memory is None else f"{memory / 2**20:.0f} MiB"),
        f"device {escape_markdown(facts.device)}.",
    ]
    blocks = [
        f"# {escape_markdown(facts.method)} on {escape_markdown(facts.scene)}",
        ", ".join(cost),
        *(f"- custom {escape_markdown(part)}" for part in facts.custom_parts),
    ]
    for modality, mean in metrics.mean.items():
        figures = [(escape_markdown(view.name), view.figures[modality]) for view in metrics.views]
        table = _table([("**mean**", mean), *figures], figure_names(modality))
        blocks += [f"## {capitalised(modality.title)}", table]
    if metrics.truth is not None:
        truths = [(escape_markdown(view.name), view.truth) for view in metrics.views if view.truth]
        table = _table([("**mean**", metrics.truth), *truths], TRUTH_FIGURES)
        blocks += ["## Against the exact truth", table]
    if metrics.aligned is not None:
        blocks += ["## With aligned poses", _aligned_text(metrics, metrics.aligned)]
    if parts is not None:
        blocks += ["## The model's parts", _parts_text(parts)]
    groups = [*metrics.mean.values(), metrics.truth or {}]
    for view in metrics.views:
        groups += [*view.figures.values(), view.truth or {}]
    reasons = dict.fromkeys(
        f"- {escape_markdown(f'{COLUMNS[name][0]}: {figure.reason}')}"
        for figures in groups
        for name, figure in figures.items()
        if isinstance(figure, Missing)
    )
    if reasons:
        blocks.append("\n".join(["A dash stands for a missing figure:\n", *reasons]))
    return "\n\n".join([*blocks, CONVENTIONS]) + "\n"


def write_report(
    folder: Path,
    facts: RunFacts,
    metrics: Metrics,
    parts: Parts | None = None,
    data: ScoredData | None = None,
) -> tuple[Path, Path]:
    """Write ``metrics.json`` and ``metrics.md`` into the folder; returns their paths. RunError if a
    file cannot be written."""
    document = to_document(facts, metrics, parts, data)
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    return (
        write_text(folder / "metrics.json", text),
        write_text(folder / "metrics.md", to_markdown(facts, metrics, parts)),
    )


SPREADS = {
    "temperature_residual_std_c": ("temperature residual t̂", " °C"),
    "heat_exchange_std_c": ("heat exchange", " °C"),
    "color_residual_std": ("colour residual ĉ", ""),
}
"""Names and units of the standard deviations in ``metrics.json``."""

PART_NAMES = {
    "temperature_residual": "t̂ the same for all",
    "heat_exchange": "no heat exchange",
    "shuffled_neighbours": "shuffled neighbours",
    "color_residual": "ĉ = 0",
}
"""What is changed in each copy of ``knock_outs``."""


def _parts_text(parts: Parts) -> str:
    """How much the parts contribute, and the held-out views' figures without each."""
    spreads = [
        f"{SPREADS[key][0]} {value:.4f}{SPREADS[key][1]}"
        for key, value in parts.spreads.to_json(parts.temperature).items()
        if value is not None
    ]
    rows = [
        f"| {PART_NAMES[part]} | {format_figure('psnr', figures['thermal_psnr'])} "
        f"| {format_figure('psnr', figures['rgb_psnr'])} "
        f"| {format_figure('mae_c', figures['truth_mae_c'])} |"
        for part, figures in parts.knock_out.items()
    ]
    lines = [
        f"Standard deviations over the Gaussians: {', '.join(spreads)}.\n",
        "| knocked out | thermal PSNR, dB | RGB PSNR, dB | against the truth, °C |",
        "|---|---|---|---|",
    ]
    return "\n".join([*lines, *rows])


def _aligned_text(metrics: Metrics, aligned: Metrics) -> str:
    """Why there are aligned poses, and the mean figures with them beside those without."""
    tables = [
        _table(
            [("poses as given", metrics.mean[modality]), ("aligned", mean)],
            figure_names(modality),
            capitalised(modality.title),
        )
        for modality, mean in aligned.mean.items()
    ]
    if metrics.truth is not None and aligned.truth is not None:
        rows = [("poses as given", metrics.truth), ("aligned", aligned.truth)]
        tables.append(_table(rows, TRUTH_FIGURES, "Against the exact truth"))
    return "\n\n".join(
        [
            f"A typical held-out photo is {metrics.pose_error_px:.1f} pixels off what the model "
            f"shows, so poses, theirs or those trained on, seem to be wrong. Here each was first "
            f"aligned with the model. The tables above use the poses as given, as other programs "
            f"do.",
            *tables,
        ]
    )


def format_figure(name: str, figure: Figure) -> str:
    """A figure for people: the usual decimals, a dash where it is missing, ∞ for a perfect PSNR."""
    number, _ = to_json(figure)
    if number is None:
        return "∞" if figure == float("inf") else "–"
    return f"{number:.{COLUMNS[name][1]}f}"


def _split(
    figures: Mapping[str, Figure], prefix: str, reasons: dict[str, str]
) -> dict[str, float | None]:
    """The figures as JSON numbers; the reason of each null is added to ``reasons``."""
    numbers: dict[str, float | None] = {}
    for name, figure in figures.items():
        numbers[name], reason = to_json(figure)
        if reason is not None:
            reasons[f"{prefix}.{name}"] = reason
    return numbers


def _table(rows: Sequence[tuple[str, Figures]], names: Sequence[str], corner: str = "") -> str:
    def row(first: str, cells: Iterable[str]) -> str:
        return " | ".join([first, *cells]) + " |"

    lines = [
        row(f"| {corner}".rstrip(), (COLUMNS[name][0] for name in names)),
        "|---|" + "---:|" * len(names),
    ]
    for label, figures in rows:
        lines.append(row(f"| {label}", (format_figure(name, figures[name]) for name in names)))
    return "\n".join(lines)
