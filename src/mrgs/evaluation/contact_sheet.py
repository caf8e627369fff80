"""One picture per run: photos, renderings, temperature errors and depth of some held-out views."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from mrgs.evaluation.evaluate import Metrics, ViewMetrics
from mrgs.evaluation.metrics import Figures, Missing
from mrgs.evaluation.report import RunFacts, format_figure
from mrgs.pictures.drawing import Scale
from mrgs.pictures.files import shown_depth, shown_values, to_rgb8
from mrgs.pictures.palette import display_range, round_up
from mrgs.pictures.sheet import Bar, Panel, PanelRow, draw_heading, draw_section, stack
from mrgs.pictures.values import unit_label
from mrgs.scene import (
    THERMAL,
    Modality,
    Pixels,
    Rendering,
    SceneBounds,
    TemperatureRange,
    View,
    evenly_spaced,
    in_order,
)

CELL_PX = 288
LABEL_PX = 148

ImageValues: TypeAlias = UInt8[np.ndarray, "h w 3"] | Float[np.ndarray, "h w"]
"""sRGB, or values that a palette shows; invalid ones are NaN."""

DEPTH_NOTE = "z-depth in scene units"
NORMALISED_NOTE = "normalised: the scene has no °C"


@dataclass(frozen=True, eq=False)
class ViewImages:
    """The images of one view.

    Attributes:
        photos: of each modality of the view: sRGB [H, W, 3], or values with a unit in that unit
            [H, W] (normalised temperatures where the scene has no °C).
        renderings: of each modality that the model renders, in the unit and size of its photo.
        depth: z-depth in scene units, infinite for the background; None if not known.
    """

    photos: Mapping[Modality, ImageValues]
    renderings: Mapping[Modality, ImageValues]
    depth: Float[np.ndarray, "h w"] | None

    @classmethod
    def of(
        cls,
        view: View,
        rendering: Rendering,
        temperature: TemperatureRange | None,
        ball: SceneBounds | None = None,
        depth_of: Modality | None = None,
    ) -> ViewImages:
        """The images of a view with its photos, and of a rendering that is compared with them, with
        its depth of the modality ``depth_of`` if known, else of the first; beyond ``ball`` depth is
        the background's. SceneError if a photo cannot be read."""
        seen = rendering.with_depth(depth_of or next(iter(rendering)))
        photos = {each: image.load() for each, image in view.images.items()}
        rendered = {each: Pixels(blend.image.detach().cpu()) for each, blend in rendering.items()}
        depth = None
        if seen is not None:
            depth = shown_depth(rendering.surface_depth(seen), view.images.get(seen), ball)
        return cls(
            {each: _values(each, pixels, temperature) for each, pixels in photos.items()},
            {each: _values(each, pixels, temperature) for each, pixels in rendered.items()},
            depth,
        )

    @property
    def errors(self) -> dict[Modality, Float[np.ndarray, "h w"]]:
        """Rendered minus measured values of each modality with a unit that has both images."""
        return {
            modality: self.renderings[modality] - photo
            for modality, photo in self.photos.items()
            if modality.is_metric and modality in self.renderings
        }


def _values(
    modality: Modality, pixels: Pixels, temperature: TemperatureRange | None
) -> ImageValues:
    if not modality.is_metric:
        return to_rgb8(pixels.values)
    shown, valid = shown_values(modality, pixels.values, temperature), pixels.valid
    return shown if valid is None else np.where(valid.numpy(), shown, np.float32(np.nan))


class SheetRows:
    """The views on a sheet: a few, evenly spaced, and the ones with the worst scores, which a mean
    hides. ``count`` views will be added."""

    def __init__(self, count: int) -> None:
        self._spread = evenly_spaced(count)
        self._rows: dict[int, tuple[ViewMetrics, ViewImages]] = {}
        self._worst: dict[Modality, tuple[float, int]] = {}

    def add(self, number: int, metrics: ViewMetrics, images: Callable[[], ViewImages]) -> None:
        """Add view ``number``, counted from 0; its images are made only if the sheet shows it,
        going by the views added so far."""
        for modality, figures in metrics.figures.items():
            psnr = figures["psnr"]
            if isinstance(psnr, float):
                score = (-math.inf if math.isnan(psnr) else psnr, number)
                self._worst[modality] = min(score, self._worst.get(modality, score))
        shown = {*self._spread, *(place for _, place in self._worst.values())}
        self._rows = {place: row for place, row in self._rows.items() if place in shown}
        if number in shown:
            self._rows[number] = metrics, images()

    @property
    def rows(self) -> list[tuple[ViewMetrics, ViewImages]]:
        """The views that the sheet shows, of the ones added so far, in their order."""
        return [self._rows[number] for number in sorted(self._rows)]


def contact_sheet(
    rows: Sequence[tuple[ViewMetrics, ViewImages]],
    facts: RunFacts,
    metrics: Metrics,
    temperature: TemperatureRange | None,
) -> Image.Image:
    """Draw the sheet: a row per view and a column per kind of image that any row has.

    Photos and renderings of a modality with a unit share one range, that of the photos shown; its
    errors have another, symmetric about zero. The ``rows`` have
    aligned poses if ``metrics`` has them."""
    columns, bars = _columns([images for _, images in rows], temperature)
    panel_rows = []
    for number, (view, _) in enumerate(rows):
        panels = [Panel(pictures[number]) for pictures in columns.values()]
        panel_rows.append(PanelRow(view.name, panels, _figures(view)))
    section = draw_section([*columns], panel_rows, bars, cell_px=CELL_PX, label_px=LABEL_PX)
    return stack([_heading(section.width, facts, metrics), section])


def _columns(
    rows: Sequence[ViewImages], temperature: TemperatureRange | None
) -> tuple[dict[str, list[UInt8[np.ndarray, "h w 3"] | None]], list[Bar]]:
    """Pictures of each row by column title, and the bars that explain their colours."""
    columns: dict[str, list[UInt8[np.ndarray, "h w 3"] | None]] = {}
    bars: list[Bar] = []

    def add(
        kinds: Mapping[str, list[ImageValues | None]], scale: Scale | None = None, note: str = ""
    ) -> None:
        first = len(columns)
        for title, values in kinds.items():
            if any(each is not None for each in values):
                columns[title] = [colored(each, scale) for each in values]
        if scale is not None and len(columns) > first:
            bars.append(Bar(scale, note, (first, len(columns) - 1)))

    for modality in in_order(each for row in rows for each in (*row.photos, *row.renderings)):
        kinds = {
            f"{modality.title} photo": [row.photos.get(modality) for row in rows],
            f"{modality.title} rendering": [row.renderings.get(modality) for row in rows],
        }
        if not modality.is_metric:
            add(kinds)
            continue
        unit = unit_label(modality, temperature)
        known = pooled([{**row.renderings, **row.photos}.get(modality) for row in rows])
        scale = Scale("inferno", *display_range(known), unit)
        add(kinds, scale, "" if unit else NORMALISED_NOTE)
        errors = [row.errors.get(modality) for row in rows]
        add({f"{modality.title} error": [*errors]}, error_scale(errors, unit), error_note(modality))
    depths = [row.depth for row in rows]
    near, far = display_range(pooled(depths), tail=1.0)
    add({"depth": [*depths]}, Scale("depth", far, near, ""), DEPTH_NOTE)
    return columns, bars


def colored(values: ImageValues | None, scale: Scale | None) -> UInt8[np.ndarray, "h w 3"] | None:
    """Values in the colours of a scale; sRGB, which has no scale, as it is."""
    return values if values is None or scale is None else scale.colorize(values)


def error_scale(errors: Sequence[np.ndarray | None], unit: str) -> Scale:
    """The scale of all errors, symmetric about zero."""
    limit = round_up(display_range(np.abs(pooled(errors)), tail=1.0)[1])
    return Scale("error", -limit, limit, unit)


def error_note(modality: Modality) -> str:
    """What the colours of the errors mean."""
    signs = "blue too cold, red too warm" if modality == THERMAL else "blue too low, red too high"
    return f"rendering minus photo: {signs}"


def pooled(images: Sequence[np.ndarray | None]) -> Float[np.ndarray, " n"]:
    """The values of all images that there are."""
    there = [image.ravel() for image in images if image is not None]
    return np.concatenate(there) if there else np.zeros(0, np.float32)


def _heading(width: int, facts: RunFacts, metrics: Metrics) -> Image.Image:
    """Scene and method on the left, the means as large numbers on the right."""
    shown = metrics.aligned or metrics
    numbers: list[tuple[str, str | None]] = []
    for modality, mean in shown.mean.items():
        numbers.append((f"{modality.title} PSNR", _with_unit(mean, "psnr", "dB")))
        numbers.append((f"{modality.title} MAE", _with_unit(mean, "mae_c", "°C")))
    numbers += [
        ("Gaussians", None if facts.gaussians is None else f"{facts.gaussians:,}"),
        ("steps", None if facts.steps is None else f"{facts.steps:,}"),
    ]
    line = f"{facts.method} · mean of {len(shown.views)} held-out views"
    if metrics.aligned is not None:
        line += ", each aligned with the model"
    known = [(caption, value) for caption, value in numbers if value is not None]
    return draw_heading(width, facts.scene, line, known)


def _figures(view: ViewMetrics) -> list[tuple[str, str]]:
    """The lines below a view's name."""
    lines = []
    for modality in in_order(view.figures):
        units = {"psnr": "dB", "ssim": "SSIM", "mae_c": "°C MAE"}
        for caption, (name, unit) in zip((modality.title, "", ""), units.items(), strict=True):
            if (shown := _with_unit(view.figures[modality], name, unit)) is not None:
                lines.append((caption, shown))
    return lines


def _with_unit(figures: Figures, name: str, unit: str) -> str | None:
    figure = figures.get(name, Missing("not a figure of this modality"))
    return None if isinstance(figure, Missing) else f"{format_figure(name, figure)} {unit}"
