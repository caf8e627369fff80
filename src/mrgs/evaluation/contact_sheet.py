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
    Scale,
    blank,
    draw_text,
    fit_text,
    scale_bar,
    text_width,
)
from mrgs.pictures.files import shown_depth, shown_values, to_rgb8
from mrgs.pictures.palette import PaletteName, display_range, round_up
from mrgs.pictures.values import unit_label
from mrgs.scene import (
    THERMAL,
    Modality,
    Pixels,
    Reach,
    Rendering,
    TemperatureRange,
    View,
    evenly_spaced,
    in_order,
)

CELL_PX = 288
LABEL_PX = 148
MARGIN_PX = 36
GAP_PX = 10
HEADER_PX = 92
TITLE_PX = 30
FOOTER_PX = 62

ImageValues: TypeAlias = UInt8[np.ndarray, "h w 3"] | Float[np.ndarray, "h w"]
"""A picture as it is, or the values that a palette shows; invalid ones are NaN."""

PHOTO, RENDERING, ERROR, DEPTH = "photo", "rendering", "error", "depth"


@dataclass(frozen=True, eq=False)
class SheetRow:
    """The images of one view on the sheet.

    Attributes:
        metrics: the view's figures.
        photos: of each modality that the view has: pictures [H, W, 3], or values with a unit in
            that unit [H, W] (normalised temperatures where the scene has no °C).
        renderings: of each modality that the model renders, in the unit and size of its photo.
        depth: z-depth in scene units, infinite where it is the background's; None if not known.
    """

    metrics: ViewMetrics
    photos: Mapping[Modality, ImageValues]
    renderings: Mapping[Modality, ImageValues]
    depth: Float[np.ndarray, "h w"] | None

    @property
    def errors(self) -> dict[Modality, Float[np.ndarray, "h w"]]:
        """Rendered minus measured values of each modality with a unit that has both images."""
        return {
            modality: self.renderings[modality] - photo
            for modality, photo in self.photos.items()
            if modality.is_metric and modality in self.renderings
        }


class SheetRows:
    """The views on a sheet: a few, evenly spaced, and those with the worst scores, which a mean
    hides.

    Args:
        count: number of views that will be added.
    """

    def __init__(self, count: int) -> None:
        self._spread = evenly_spaced(count)
        self._rows: dict[int, SheetRow] = {}
        self._worst: dict[Modality, tuple[float, int]] = {}

    def add(self, number: int, metrics: ViewMetrics, make_row: Callable[[], SheetRow]) -> None:
        """Add view ``number``, counted from 0; its row is made only if the sheet shows it, going by
        the views added so far."""
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
        """The rows of the views added so far that the sheet shows, in the order of the views."""
        return [self._rows[number] for number in sorted(self._rows)]


class _Scales(NamedTuple):
    """The scales of a sheet.

    Attributes:
        values: of each modality with a unit; the unit is empty for temperatures without °C.
        errors: of each of these modalities.
        depth: from far to near, scene units.
    """

    values: dict[Modality, Scale]
    errors: dict[Modality, Scale]
    depth: Scale


class _SheetColumn(NamedTuple):
    """A column of the sheet; the depth belongs to no modality."""

    modality: Modality | None
    kind: str

    @property
    def title(self) -> str:
        """Heading of the column."""
        return self.kind if self.modality is None else f"{self.modality.title} {self.kind}"


def sheet_row(
    view: View,
    rendering: Rendering,
    metrics: ViewMetrics,
    temperature: TemperatureRange | None,
    ball: Reach | None = None,
    depth_of: Modality | None = None,
) -> SheetRow:
    """Make the contact sheet's row of one view.

    Args:
        view: with its photos.
        rendering: compared with them.
        metrics: the view's figures.
        temperature: the scene's; None without °C.
        ball: how far the scene reaches; the background beyond it does not count on the scale of the
            depth. None if there is none.
        depth_of: the modality whose depth is shown if it is known, else another one; None for the
            first.
    """
    seen = rendering.with_depth(depth_of or next(iter(rendering)))
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
        else shown_depth(rendering.surface_depth(seen), view.images.get(seen), ball),
    )


def contact_sheet(
    rows: Sequence[SheetRow],
    facts: RunFacts,
    metrics: Metrics,
    temperature: TemperatureRange | None,
    palette: PaletteName = "inferno",
) -> Image.Image:
    """Draw the sheet: a row per view and a column per image; a column that no row has is left out.

    Photos and renderings of a modality with a unit share one range, that of the photos shown; its
    errors have another, symmetric about zero.

    Args:
        rows: with aligned poses, if ``metrics`` has such.
        facts: of the run, for the heading.
        metrics: for the heading.
        temperature: the scene's scale; None without °C.
        palette: of the values with a unit.

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
    sheet = blank((width, height))
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
    if not modality.is_metric:
        return to_rgb8(pixels.values)
    shown = shown_values(modality, pixels.values, temperature)
    return (
        shown if pixels.valid is None else np.where(pixels.valid.numpy(), shown, np.float32(np.nan))
    )


def _scales(
    rows: Sequence[SheetRow], temperature: TemperatureRange | None, palette: PaletteName
) -> _Scales:
    shown = in_order(modality for row in rows for modality in (*row.photos, *row.renderings))
    values, errors = {}, {}
    for modality in shown:
        if modality.is_metric:
            unit = unit_label(modality, temperature)
            photos = _pool([{**row.renderings, **row.photos}.get(modality) for row in rows])
            values[modality] = Scale(palette, *display_range(photos), unit)
            differences = np.abs(_pool([row.errors.get(modality) for row in rows]))
            limit = round_up(display_range(differences, tail=1.0)[1])
            errors[modality] = Scale("error", -limit, limit, unit)
    near, far = display_range(_pool([row.depth for row in rows]), tail=1.0)
    return _Scales(values, errors, Scale("depth", far, near, ""))


def _pool(images: Sequence[np.ndarray | None]) -> np.ndarray:
    there = [image.ravel() for image in images if image is not None]
    return np.concatenate(there) if there else np.zeros(0, np.float32)


def _cells(row: SheetRow, scales: _Scales) -> dict[_SheetColumn, UInt8[np.ndarray, "h w 3"]]:
    """The row's pictures; values and depths through their palettes."""
    cells = {}
    for kind, images in ((PHOTO, row.photos), (RENDERING, row.renderings)):
        for modality, values in images.items():
            scale = scales.values.get(modality)
            shown = values if scale is None else scale.colorize(values)
            cells[_SheetColumn(modality, kind)] = shown
    for modality, error in row.errors.items():
        cells[_SheetColumn(modality, ERROR)] = scales.errors[modality].colorize(error)
    if row.depth is not None:
        cells[_SheetColumn(None, DEPTH)] = scales.depth.colorize(row.depth)
    return cells


def _columns(cells: Sequence[Mapping[_SheetColumn, np.ndarray]]) -> list[_SheetColumn]:
    """Those that any row has: by modality photo, rendering and error, then the depth."""
    there = {column for row in cells for column in row}
    modalities = in_order(column.modality for column in there if column.modality is not None)
    columns = [
        _SheetColumn(modality, kind)
        for modality in modalities
        for kind in (PHOTO, RENDERING, ERROR)
    ]
    return [column for column in [*columns, _SheetColumn(None, DEPTH)] if column in there]


def _row_height(images: Mapping[_SheetColumn, np.ndarray]) -> int:
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
    numbers, shown = [], metrics.aligned or metrics
    for modality, mean in shown.mean.items():
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
    line = f"{facts.method} · mean of {len(shown.views)} held-out views"
    if metrics.aligned is not None:
        line += ", each aligned with the model"
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
    sheet: Image.Image, scales: _Scales, offsets: Mapping[_SheetColumn, int], y: int
) -> None:
    """One bar under the columns that it explains."""
    bars: list[tuple[tuple[_SheetColumn, ...], Scale, str]] = [
        ((_SheetColumn(None, DEPTH),), scales.depth, "z-depth in scene units")
    ]
    for modality, scale in scales.values.items():
        images = _SheetColumn(modality, PHOTO), _SheetColumn(modality, RENDERING)
        bars.append((images, scale, "" if scale.unit else "normalised: the scene has no °C"))
        signs = (
            "blue too cold, red too warm" if modality == THERMAL else "blue too low, red too high"
        )
        error = _SheetColumn(modality, ERROR)
        bars.append(((error,), scales.errors[modality], f"rendering minus photo: {signs}"))
    for columns, scale, note in bars:
        starts = [offsets[column] for column in columns if column in offsets]
        if not starts:
            continue
        bar = scale_bar(scale, starts[-1] + CELL_PX - starts[0], "horizontal")
        sheet.paste(bar, (starts[0], y))
        draw_text(sheet, (starts[0], y + bar.height + 14), note, 12, MUTED)
