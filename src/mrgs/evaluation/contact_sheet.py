"""One picture per run: photos, renderings, the temperature error and the depth of some held-out
views."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

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
from mrgs.render import Rendering
from mrgs.scene import Pixels, Reach, TemperatureRange, View, spread

CELL_PX = 288
LABEL_PX = 148
MARGIN_PX = 36
GAP_PX = 10
HEADER_PX = 92
TITLE_PX = 30
FOOTER_PX = 62

_TITLES = {
    "photo": "RGB photo",
    "rgb": "RGB rendering",
    "measured": "thermal photo",
    "thermal": "thermal rendering",
    "error": "thermal error",
    "depth": "depth",
}


@dataclass(frozen=True, eq=False)
class SheetRow:
    """One view's images as they are shown; None where the view or the model has none. Invalid
    pixels are NaN.

    Attributes:
        metrics: the view's figures.
        photo: RGB photo.
        rgb: RGB rendering.
        measured: thermal photo in the sheet's thermal unit.
        thermal: thermal rendering in the same unit and size.
        depth: z-depth in scene units, infinite where it is the background's.
    """

    metrics: ViewMetrics
    photo: UInt8[np.ndarray, "h w 3"] | None
    rgb: UInt8[np.ndarray, "h w 3"] | None
    measured: Float[np.ndarray, "h2 w2"] | None
    thermal: Float[np.ndarray, "h2 w2"] | None
    depth: Float[np.ndarray, "h3 w3"] | None

    @property
    def error(self) -> Float[np.ndarray, "h2 w2"] | None:
        """Rendered minus measured temperature."""
        return (
            None if self.measured is None or self.thermal is None else self.thermal - self.measured
        )


class SheetRows:
    """The views that a sheet shows: a few spread evenly, and those that score worst, which a mean
    hides.

    Args:
        count: of the views.
    """

    def __init__(self, count: int) -> None:
        self._spread = spread(count)
        self._rows: dict[int, SheetRow] = {}
        self._worst: dict[str, tuple[float, int]] = {}

    def add(self, number: int, metrics: ViewMetrics, make_row: Callable[[], SheetRow]) -> None:
        """Take a view by its number, from 0; its row is made only if it is shown as far as is known
        by now."""
        for modality, figures in (("thermal", metrics.thermal), ("rgb", metrics.rgb)):
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


def sheet_row(
    view: View,
    rendering: Rendering,
    metrics: ViewMetrics,
    temperature: TemperatureRange | None,
    ball: Reach | None = None,
) -> SheetRow:
    """A row from what ``evaluate`` hands to its visitor; temperatures in °C where the scene has
    them.

    The background of ``ball`` does not count on the scale of the depth.
    """
    photo = None if view.rgb is None else to_rgb8(view.rgb.load().values)
    measured = None if view.thermal is None else _thermal(view.thermal.load(), temperature)
    depth, seen = (rendering.depth_rgb, view.rgb)
    if depth is None:
        depth, seen = (rendering.depth_thermal, view.thermal)
    return SheetRow(
        metrics=metrics,
        photo=photo,
        rgb=None if rendering.rgb is None else to_rgb8(rendering.rgb),
        measured=measured,
        thermal=None
        if rendering.thermal is None
        else _thermal(Pixels(rendering.thermal.detach().cpu()), temperature),
        depth=None if depth is None else shown_depth(depth, seen, ball),
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
    columns = [name for name in _TITLES if any(row[name] is not None for row in cells)]
    heights = [_row_height(row) for row in cells]
    left = MARGIN_PX + LABEL_PX
    width = left + len(columns) * CELL_PX + (len(columns) - 1) * GAP_PX + MARGIN_PX
    height = (
        HEADER_PX + TITLE_PX + sum(heights) + GAP_PX * (len(rows) - 1) + FOOTER_PX + MARGIN_PX // 2
    )
    sheet = Image.new("RGB", (width, height), PAPER)
    _draw_header(sheet, facts, metrics)
    offsets = {name: left + index * (CELL_PX + GAP_PX) for index, name in enumerate(columns)}
    for name, x in offsets.items():
        draw_text(sheet, (x, HEADER_PX + 18), _TITLES[name], 15, INK)
    y = HEADER_PX + TITLE_PX
    for row, images, row_height in zip(rows, cells, heights, strict=True):
        _draw_label(sheet, row.metrics, y)
        for name, x in offsets.items():
            _draw_cell(sheet, images[name], (x, y), row_height)
        y += row_height + GAP_PX
    _draw_scale_bars(sheet, scales, offsets, y + 4)
    return sheet


def _thermal(pixels: Pixels, temperature: TemperatureRange | None) -> Float[np.ndarray, "h w"]:
    values = pixels.values[..., 0]
    shown = to_array(values if temperature is None else temperature.to_celsius(values))
    return (
        shown if pixels.valid is None else np.where(pixels.valid.numpy(), shown, np.float32(np.nan))
    )


def _scales(
    rows: Sequence[SheetRow], temperature: TemperatureRange | None, palette: PaletteName
) -> _Scales:
    unit = "" if temperature is None else "°C"
    photos = _pool([row.measured if row.measured is not None else row.thermal for row in rows])
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


def _cells(row: SheetRow, scales: _Scales) -> dict[str, np.ndarray | None]:
    def shown(values: np.ndarray | None, scale: Scale) -> np.ndarray | None:
        return None if values is None else colorize(values, scale.low, scale.high, scale.palette)

    return {
        "photo": row.photo,
        "rgb": row.rgb,
        "measured": shown(row.measured, scales.thermal),
        "thermal": shown(row.thermal, scales.thermal),
        "error": shown(row.error, scales.error),
        "depth": shown(row.depth, scales.depth),
    }


def _row_height(images: dict[str, np.ndarray | None]) -> int:
    """The tallest image at the cell's width, but no taller than 4:3 upright."""
    heights = [
        round(CELL_PX * image.shape[0] / image.shape[1])
        for image in images.values()
        if image is not None
    ]
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
    numbers = [
        ("thermal PSNR", _with_unit(metrics.thermal, "psnr", "dB")),
        ("thermal MAE", _with_unit(metrics.thermal, "mae_c", "°C")),
        ("RGB PSNR", _with_unit(metrics.rgb, "psnr", "dB")),
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
    lines = [
        ("RGB", _with_unit(metrics.rgb, "psnr", "dB")),
        ("", _with_unit(metrics.rgb, "ssim", "SSIM")),
        ("thermal", _with_unit(metrics.thermal, "psnr", "dB")),
        ("", _with_unit(metrics.thermal, "ssim", "SSIM")),
        ("", _with_unit(metrics.thermal, "mae_c", "°C MAE")),
    ]
    baseline = y + 40
    for caption, value in lines:
        if value is None:
            continue
        draw_text(sheet, (MARGIN_PX, baseline), caption, 12, MUTED)
        draw_text(sheet, (MARGIN_PX + 54, baseline), value, 12, INK)
        baseline += 18


def _with_unit(figures: Figures, name: str, unit: str) -> str | None:
    figure = figures[name]
    return None if isinstance(figure, Missing) else f"{format_figure(name, figure)} {unit}"


def _draw_scale_bars(sheet: Image.Image, scales: _Scales, offsets: dict[str, int], y: int) -> None:
    """One bar under the columns that it explains."""
    for names, scale, note in (
        (
            ("measured", "thermal"),
            scales.thermal,
            "" if scales.thermal.unit else "normalised: the scene has no °C",
        ),
        (("error",), scales.error, "rendering minus photo: blue too cold, red too warm"),
        (("depth",), scales.depth, "z-depth in scene units"),
    ):
        starts = [offsets[name] for name in names if name in offsets]
        if not starts:
            continue
        bar = scale_bar(scale, starts[-1] + CELL_PX - starts[0], "horizontal")
        sheet.paste(bar, (starts[0], y))
        draw_text(sheet, (starts[0], y + bar.height + 14), note, 12, MUTED)
