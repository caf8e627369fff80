"""One picture per run: photos, renderings, the temperature error and the depth of some held-out
views."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from mrgs.evaluation.evaluate import Metrics, ViewMetrics
from mrgs.evaluation.figures import Figures, Missing
from mrgs.evaluation.report import RunFacts, format_figure
from mrgs.pictures.drawing import (
    HAIRLINE,
    INK,
    MUTED,
    PAPER,
    Scale,
    draw_text,
    fit_text,
    scale_bar,
    text_width,
)
from mrgs.pictures.files import shown_depth, to_array, to_rgb8
from mrgs.pictures.palette import PaletteName, colorize, display_range, round_up
from mrgs.scene import (
    RGB,
    THERMAL,
    Modality,
    Pixels,
    Reach,
    Rendering,
    TemperatureRange,
    View,
    in_order,
    spread,
)

CELL_PX = 288
LABEL_PX = 148
MARGIN_PX = 36
GAP_PX = 10
HEADER_PX = 92
TITLE_PX = 30
FOOTER_PX = 62

ImageValues: TypeAlias = UInt8[np.ndarray, "h w 3"] | Float[np.ndarray, "h w"]
"""A picture as it is, or the temperatures that a palette shows; invalid ones are NaN."""

PHOTO, RENDERING, ERROR, DEPTH = "photo", "rendering", "error", "depth"


@dataclass(frozen=True, eq=False)
class SheetRow:
    """One view's images as they are shown.

    Attributes:
        metrics: the view's figures.
        photos: of the modalities that the view has; temperatures in the sheet's thermal unit.
        renderings: of those that the model renders, in the same unit and size.
        depth: z-depth in scene units, infinite where it is the background's; None if not known.
    """

    metrics: ViewMetrics
    photos: Mapping[Modality, ImageValues]
    renderings: Mapping[Modality, ImageValues]
    depth: Float[np.ndarray, "h w"] | None

    @property
    def error(self) -> Float[np.ndarray, "h w"] | None:
        """Rendered minus measured temperature; None if either is not there."""
        if THERMAL not in self.photos or THERMAL not in self.renderings:
            return None
        return self.renderings[THERMAL] - self.photos[THERMAL]


class SheetRows:
    """The views that a sheet shows: a few spread evenly, and those that score worst, which a mean
    hides.

    Args:
        count: of the views.
    """

    def __init__(self, count: int) -> None:
        self._spread = spread(count)
        self._rows: dict[int, SheetRow] = {}
        self._worst: dict[Modality, tuple[float, int]] = {}

    def add(self, number: int, metrics: ViewMetrics, make_row: Callable[[], SheetRow]) -> None:
        """Take a view by its number, from 0; its row is made only if it is shown as far as is known
        by now."""
        for modality, figures in metrics.figures.items():
            psnr = figures["psnr"]
            if isinstance(psnr, float):
                score = (-math.inf if math.isnan(psnr) else psnr, number)
                self._worst[modality] = min(score, self._worst.get(modality, score))
        shown = {*self._spread, *(place for _, place in self._worst.values())}
        self._rows = {place: row for place, row in self._rows.items() if place in shown}
        if number in shown:
            self._rows[number] = make_row()

    @property
    def rows(self) -> list[SheetRow]:
        """What is shown of the views so far, in their order."""
        return [self._rows[number] for number in sorted(self._rows)]


class _Scales(NamedTuple):
    """The three scales of a sheet; the thermal ones have an empty unit where the scene has no
    °C."""

    thermal: Scale
    error: Scale
    depth: Scale


class _Column(NamedTuple):
    """A column of the sheet; the depth belongs to no modality."""

    modality: Modality | None
    kind: str

    @property
    def title(self) -> str:
        """Its heading."""
        return self.kind if self.modality is None else f"{self.modality.title} {self.kind}"


def sheet_row(
    view: View,
    rendering: Rendering,
    metrics: ViewMetrics,
    temperature: TemperatureRange | None,
    ball: Reach | None = None,
    depth_of: Modality = RGB,
) -> SheetRow:
    """A row from what ``evaluate`` hands to its visitor; temperatures in °C where the scene has
    them.

    The background of ``ball`` does not count on the scale of the depth, which is that of
    ``depth_of`` if it is known, or else of another modality.
    """
    seen = rendering.with_depth(depth_of)
    return SheetRow(
        metrics=metrics,
        photos={
            modality: _values(modality, image.load(), temperature)
            for modality, image in view.images.items()
        },
        renderings={
            modality: _values(modality, Pixels(blend.image.detach().cpu()), temperature)
            for modality, blend in rendering.items()
        },
        depth=None
        if seen is None
        else shown_depth(rendering[seen].depth, view.images.get(seen), ball),
    )


def contact_sheet(
    rows: Sequence[SheetRow],
    facts: RunFacts,
    metrics: Metrics,
    temperature: TemperatureRange | None,
    palette: PaletteName = "inferno",
) -> Image.Image:
    """Draw the sheet: a row per view and a column per image; a column that no row has is left out.

    Both thermal columns share one range, that of the photos shown; the errors share another,
    symmetric about zero.

    Raises:
        ValueError: there are no rows.
    """
    if not rows:
        raise ValueError("a contact sheet needs at least one row")
    scales = _scales(rows, temperature, palette)
    cells = [_cells(row, scales) for row in rows]
    columns = _columns(cells)
    heights = [_row_height(row) for row in cells]
    left = MARGIN_PX + LABEL_PX
    width = left + len(columns) * CELL_PX + (len(columns) - 1) * GAP_PX + MARGIN_PX
    height = (
        HEADER_PX + TITLE_PX + sum(heights) + GAP_PX * (len(rows) - 1) + FOOTER_PX + MARGIN_PX // 2
    )
    sheet = Image.new("RGB", (width, height), PAPER)
    _draw_header(sheet, facts, metrics)
    offsets = {column: left + index * (CELL_PX + GAP_PX) for index, column in enumerate(columns)}
    for column, x in offsets.items():
        draw_text(sheet, (x, HEADER_PX + 18), column.title, 15, INK)
    y = HEADER_PX + TITLE_PX
    for row, images, row_height in zip(rows, cells, heights, strict=True):
        _draw_label(sheet, row.metrics, y)
        for column, x in offsets.items():
            _draw_cell(sheet, images.get(column), (x, y), row_height)
        y += row_height + GAP_PX
    _draw_scale_bars(sheet, scales, offsets, y + 4)
    return sheet


def _values(
    modality: Modality, pixels: Pixels, temperature: TemperatureRange | None
) -> ImageValues:
    if modality != THERMAL:
        return to_rgb8(pixels.values)
    values = pixels.values[..., 0]
    shown = to_array(values if temperature is None else temperature.to_celsius(values))
    return (
        shown if pixels.valid is None else np.where(pixels.valid.numpy(), shown, np.float32(np.nan))
    )


def _scales(
    rows: Sequence[SheetRow], temperature: TemperatureRange | None, palette: PaletteName
) -> _Scales:
    unit = "" if temperature is None else "°C"
    photos = _pool([{**row.renderings, **row.photos}.get(THERMAL) for row in rows])
    depths = _pool([row.depth for row in rows])
    _, largest = display_range(np.abs(_pool([row.error for row in rows])), tail=1.0)
    limit = round_up(largest)
    near, far = display_range(depths, tail=1.0)
    return _Scales(
        Scale(palette, *display_range(photos), unit),
        Scale("error", -limit, limit, unit),
        Scale("depth", far, near, ""),
    )


def _pool(images: Sequence[np.ndarray | None]) -> np.ndarray:
    there = [image.ravel() for image in images if image is not None]
    return np.concatenate(there) if there else np.zeros(0, np.float32)


def _cells(row: SheetRow, scales: _Scales) -> dict[_Column, UInt8[np.ndarray, "h w 3"]]:
    """The row's pictures; temperatures and depths through their palettes."""
    cells = {}
    for kind, images in ((PHOTO, row.photos), (RENDERING, row.renderings)):
        for modality, values in images.items():
            shown = _colored(values, scales.thermal) if modality == THERMAL else values
            cells[_Column(modality, kind)] = shown
    if row.error is not None:
        cells[_Column(THERMAL, ERROR)] = _colored(row.error, scales.error)
    if row.depth is not None:
        cells[_Column(None, DEPTH)] = _colored(row.depth, scales.depth)
    return cells


def _colored(values: Float[np.ndarray, "h w"], scale: Scale) -> UInt8[np.ndarray, "h w 3"]:
    return colorize(values, scale.low, scale.high, scale.palette)


def _columns(cells: Sequence[Mapping[_Column, np.ndarray]]) -> list[_Column]:
    """Those that any row has: by modality photo, rendering and error, then the depth."""
    there = {column for row in cells for column in row}
    modalities = in_order(column.modality for column in there if column.modality is not None)
    columns = [
        _Column(modality, kind) for modality in modalities for kind in (PHOTO, RENDERING, ERROR)
    ]
    return [column for column in [*columns, _Column(None, DEPTH)] if column in there]


def _row_height(images: Mapping[_Column, np.ndarray]) -> int:
    """The tallest image at the cell's width, but no taller than 4:3 upright."""
    heights = [round(CELL_PX * image.shape[0] / image.shape[1]) for image in images.values()]
    return min(max([*heights, CELL_PX // 2]), CELL_PX * 4 // 3)


def _draw_cell(
    sheet: Image.Image, pixels: np.ndarray | None, corner: tuple[int, int], height: int
) -> None:
    """The image, as large as the cell allows, in its middle; a dash where there is none."""
    x, y = corner
    if pixels is None:
        draw_text(sheet, (x + CELL_PX / 2, y + height / 2), "-", 18, MUTED, anchor="mm")
        return
    image = Image.fromarray(pixels)
    scale = min(CELL_PX / image.width, height / image.height)
    size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
    image = image.resize(size, Image.Resampling.LANCZOS if scale < 1 else Image.Resampling.BICUBIC)
    sheet.paste(image, (x + (CELL_PX - image.width) // 2, y + (height - image.height) // 2))


def _draw_header(sheet: Image.Image, facts: RunFacts, metrics: Metrics) -> None:
    """Method and scene on the left, the means as large numbers on the right."""
    numbers = []
    for modality, mean in metrics.mean.items():
        numbers.append((f"{modality.title} PSNR", _with_unit(mean, "psnr", "dB")))
        numbers.append((f"{modality.title} MAE", _with_unit(mean, "mae_c", "°C")))
    numbers += [
        ("Gaussians", None if facts.gaussians is None else f"{facts.gaussians:,}"),
        ("steps", None if facts.steps is None else f"{facts.steps:,}"),
    ]
    right = float(sheet.width - MARGIN_PX)
    title_end = MARGIN_PX + 260
    for caption, value in reversed(
        [(caption, value) for caption, value in numbers if value is not None]
    ):
        width = max(text_width(value, 22), text_width(caption, 13))
        if right - width < title_end:
            break
        draw_text(sheet, (right, 46), value, 22, INK, anchor="rs")
        draw_text(sheet, (right, 66), caption, 13, MUTED, anchor="rs")
        right -= width + 34
    room = right - MARGIN_PX
    draw_text(sheet, (MARGIN_PX, 46), fit_text(facts.scene, 28, room), 28, INK, bold=True)
    line = f"{facts.method} · mean of {len(metrics.views)} held-out views"
    draw_text(sheet, (MARGIN_PX, 66), fit_text(line, 13, room), 13, MUTED)
    ImageDraw.Draw(sheet).line([(MARGIN_PX, 80), (sheet.width - MARGIN_PX, 80)], fill=HAIRLINE)


def _draw_label(sheet: Image.Image, metrics: ViewMetrics, y: int) -> None:
    """The view's name and its figures, at the left of its row."""
    draw_text(sheet, (MARGIN_PX, y + 15), fit_text(metrics.name, 15, LABEL_PX - 14), 15, INK)
    lines = []
    for modality in in_order(metrics.figures):
        figures = metrics.figures[modality]
        lines.append((modality.title, _with_unit(figures, "psnr", "dB")))
        lines.append(("", _with_unit(figures, "ssim", "SSIM")))
        lines.append(("", _with_unit(figures, "mae_c", "°C MAE")))
    baseline = y + 40
    for caption, value in lines:
        if value is None:
            continue
        draw_text(sheet, (MARGIN_PX, baseline), caption, 12, MUTED)
        draw_text(sheet, (MARGIN_PX + 54, baseline), value, 12, INK)
        baseline += 18


def _with_unit(figures: Figures, name: str, unit: str) -> str | None:
    figure = figures.get(name, Missing("not a figure of this modality"))
    return None if isinstance(figure, Missing) else f"{format_figure(name, figure)} {unit}"


def _draw_scale_bars(
    sheet: Image.Image, scales: _Scales, offsets: Mapping[_Column, int], y: int
) -> None:
    """One bar under the columns that it explains."""
    for columns, scale, note in (
        (
            (_Column(THERMAL, PHOTO), _Column(THERMAL, RENDERING)),
            scales.thermal,
            "" if scales.thermal.unit else "normalised: the scene has no °C",
        ),
        (
            (_Column(THERMAL, ERROR),),
            scales.error,
            "rendering minus photo: blue too cold, red too warm",
        ),
        ((_Column(None, DEPTH),), scales.depth, "z-depth in scene units"),
    ):
        starts = [offsets[column] for column in columns if column in offsets]
        if not starts:
            continue
        bar = scale_bar(scale, starts[-1] + CELL_PX - starts[0], "horizontal")
        sheet.paste(bar, (starts[0], y))
        draw_text(sheet, (starts[0], y + bar.height + 14), note, 12, MUTED)
