"""The figures of runs, and their statistics over seeds."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from mrgs.evaluation.figures import REPORTED, Figure, Missing
from mrgs.scene import THERMAL


class Kind(NamedTuple):
    """Properties of a figure.

    Attributes:
        decimals: as printed; ``paper_decimals`` as the paper prints it.
        better: which direction is better; None where neither is (the camera's own error).
    """

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
    """The result of one run, or of one set of another program's renders.

    Attributes:
        seed: of the run; None for renders.
        document: the content of ``metrics.json``; None where there is none.
        failure: why there is none.
    """

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
    """Mean and sample standard deviation over seeds.

    Attributes:
        std: None for fewer than two seeds.
        note: why it is missing, or what it leaves out.
    """

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
    """The mean over scenes of the seeds that have all of them, and its standard deviation over
    seeds."""
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


def _figure(document: dict[str, Any], name: str) -> Figure:
    if name == "gaussians_k":
        return _scaled(_number(document, "gaussians"), 1e-3)
    if name == "minutes":
        return _scaled(_number(document, "train_seconds"), 1 / 60)
    group, _, key = name.partition(".")
    if group == "poses":
        poses = document.get("poses")
        if name.startswith("poses.aligned") and isinstance(poses, dict) and "aligned" not in poses:
            right = "the poses of the held-out photos are right, as far as this model tells"
            error_px = _number(document, "poses.error_px")
            return error_px if isinstance(error_px, Missing) else Missing(right)
        return _number(document, name)
    if group != "truth":
        return _number(document, f"mean.{group}.{key}")
    if "truth" not in document:
        return Missing("the scene has no exact truth")
    if key == "depth_percent":
        return _scaled(_number(document, "truth.depth_median_relative_error"), 100.0)
    if key == "ratio":
        error, camera = _number(document, "truth.mae_c"), _number(document, "truth.camera_mae_c")
        if isinstance(error, Missing) or isinstance(camera, Missing):
            return error if isinstance(error, Missing) else camera
        return error / camera if camera > 0 else Missing("the camera makes no error")
    return _number(document, f"truth.{key}")


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


def _scaled(figure: Figure, factor: float) -> Figure:
    return figure if isinstance(figure, Missing) else figure * factor
