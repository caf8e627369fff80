"""Figures: numbers, or the reasons why they are missing."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeAlias

from mrgs.scene import BUILT_IN, THERMAL, Modality, metric_first

PIXEL_FIGURES = ("psnr", "psnr_matched", "ssim", "ssim_pair_range")
CELSIUS_FIGURES = ("mae_c", "mae_foreground_c")

REPORTED = metric_first(BUILT_IN)
"""The modalities that every report lists, in its order; others follow."""


def figure_names(modality: Modality) -> tuple[str, ...]:
    """Names of the figures that images of a modality are scored by."""
    celsius = CELSIUS_FIGURES if modality == THERMAL else ()
    return (*PIXEL_FIGURES, *celsius, "lpips")


class Missing(NamedTuple):
    """A missing figure.

    Attributes:
        reason: why it is missing: a clause without a full stop.
    """

    reason: str


Figure: TypeAlias = float | Missing
Figures: TypeAlias = dict[str, float | Missing]


def all_missing(names: Iterable[str], reason: str) -> Figures:
    """Figures of these names, all missing for one reason."""
    return {name: Missing(reason) for name in names}


def mean_figure(figures: Sequence[Figure]) -> Figure:
    """Mean of one figure over the views that have it; missing, with the first view's reason, if no
    view has it.

    An infinite figure (the PSNR of identical images) makes the mean infinite: leaving it out would
    understate it.
    """
    numbers = [figure for figure in figures if not isinstance(figure, Missing)]
    if not numbers:
        return figures[0] if figures else Missing("no view to score")
    return math.fsum(numbers) / len(numbers) if all(map(math.isfinite, numbers)) else sum(numbers)


def mean_figures(views: Sequence[Figures], names: Iterable[str]) -> Figures:
    """Mean over the views of each named figure, see ``mean_figure``."""
    return {name: mean_figure([view[name] for view in views]) for name in names}


def to_json(figure: Figure) -> tuple[float | None, str | None]:
    """A figure as (number, None), or as (None, reason) if it is missing, NaN or infinite, which
    JSON cannot express."""
    if isinstance(figure, Missing):
        return None, figure.reason
    if math.isnan(figure):
        return None, "not a number: the rendering holds NaN"
    if math.isinf(figure):
        return (
            None,
            "infinite: the images are identical"
            if figure > 0
            else "not finite: the rendering overflows",
        )
    return float(figure), None
