"""Temperatures of all photos: charts as SVG, and notes from the thermal files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from mrgs.pictures.html import render
from mrgs.pictures.numbers import number_text
from mrgs.pictures.palette import display_range, palette_table, round_ticks, tick_labels
from mrgs.pictures.settings import settings_of
from mrgs.pictures.values import capitalised
from mrgs.prepare.page.previews import Preview
from mrgs.scene import THERMAL
from mrgs.scene.radiometry import PhotoRecord
from mrgs.system.wording import counted

_BINS = 90
_TEMPLATE = "prepare/page/chart.svg"
_WIDTH, _HEIGHT = 900, 190
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 12, 10, 34
_FRAME = {
    "width": _WIDTH,
    "height": _HEIGHT,
    "left": _LEFT,
    "right": _WIDTH - _RIGHT,
    "bottom": _HEIGHT - _BOTTOM,
    "label_y": _HEIGHT - 10,
}
_LABEL_MARGIN = 60
"""Labels nearer than this to the right border end at their tick, px."""


class TemperatureSpread(NamedTuple):
    """Distribution of the temperatures in one photo, in °C or relative.

    Attributes:
        name: of the view.
        lowest: minimum.
        low: 5th percentile.
        median: 50th percentile.
        high: 95th percentile.
        highest: maximum.
    """

    name: str
    lowest: float
    low: float
    median: float
    high: float
    highest: float


class Temperatures(NamedTuple):
    """The section ``temperatures`` of ``sections.html``.

    Attributes:
        has_celsius: whether the values are °C.
        facts: rows of the table.
        histogram: SVG of all pixels.
        spreads: SVG with a column per photo.
        notes: sentences from the thermal files.
        counted: which photos' pixels are counted.
    """

    has_celsius: bool
    facts: Sequence[tuple[str, str]]
    histogram: Markup
    spreads: Markup
    notes: list[str]
    counted: str


def temperatures(
    previews: Sequence[Preview],
    unit: str,
    facts: Sequence[tuple[str, str]],
    notes: Mapping[str, int],
    total: int,
) -> Temperatures | None:
    """Charts of the thermal images; None without any.

    Args:
        previews: views whose pixels are counted.
        unit: °C, or empty for relative values.
        notes: sentences from the thermal files, with the number of photos that have each.
        total: number of views, of which ``previews`` may be a part.
    """
    images = {view.name: view.images[THERMAL].pixels for view in previews if THERMAL in view.images}
    found = [temperature_spread(name, image) for name, image in images.items()]
    spreads = [spread for spread in found if spread is not None]
    if not spreads:
        return None
    low, high = min(item.lowest for item in spreads), max(item.highest for item in spreads)
    low, high = (low, high) if high > low else display_range(np.array([low, high]))
    values = np.concatenate([image[np.isfinite(image)] for image in images.values()])
    counts, _ = np.histogram(values, bins=_BINS, range=(low, high))
    return Temperatures(
        bool(unit),
        facts,
        histogram(counts.astype(np.float64), low, high, unit),
        spread_chart(spreads, low, high, unit),
        [text if count == 1 else f"{text} ({count} photos)" for text, count in notes.items()],
        "All photos" if total == len(previews) else f"{len(previews)} of {total} photos",
    )


SETTINGS_THAT_COUNT = ("emissivity", "reflected_c", "distance_m")
"""Without these nobody can judge the temperatures: the page says where they are missing."""


def setting_rows(records: Sequence[PhotoRecord]) -> list[tuple[str, str]]:
    """What the temperatures were computed with, where it is from, and where it is missing."""
    rows = []
    for name, setting in settings_of(records).items():
        if not setting.value:
            if name in SETTINGS_THAT_COUNT:
                rows.append((capitalised(setting.label), "not in the photos' files"))
            continue
        text = f"{setting.value}, {'given by you' if setting.given else 'from the photos'}"
        if setting.differs:
            text += "; differs between the photos"
        if setting.missing:
            text += f"; not known of {counted(setting.missing, 'photo')}"
        rows.append((capitalised(setting.label), text))
    return rows


def temperature_spread(name: str, values: Float[np.ndarray, "h w"]) -> TemperatureSpread | None:
    """Minimum, percentiles and maximum of a thermal image (NaN where not valid); None if no pixel
    is valid."""
    known = values[np.isfinite(values)]
    if not known.size:
        return None
    low, median, high = (float(value) for value in np.percentile(known, [5, 50, 95]))
    return TemperatureSpread(name, float(known.min()), low, median, high, float(known.max()))


def histogram(counts: Float[np.ndarray, " n"], low: float, high: float, unit: str) -> Markup:
    """SVG of the number of pixels by temperature; empty if there are none.

    Args:
        counts: one per equal step from ``low`` to ``high``.
    """
    if not counts.sum():
        return Markup()
    width = (_WIDTH - _LEFT - _RIGHT) / len(counts)
    heights = (_HEIGHT - _TOP - _BOTTOM) * counts / counts.max()
    colors = palette_table("inferno")[np.linspace(20, 235, len(counts)).astype(int)]
    bars = [
        (_LEFT + index * width, _HEIGHT - _BOTTOM - height, height, "#" + bytes(color).hex())
        for index, (height, color) in enumerate(zip(heights, colors, strict=True))
        if height > 0
    ]
    ticks = [
        (x, label, "end" if x > _WIDTH - _LABEL_MARGIN else "middle")
        for share, label in _ticks(low, high, 8, unit)
        for x in [_LEFT + (_WIDTH - _LEFT - _RIGHT) * share]
    ]
    return render(
        _TEMPLATE, text="histogram of the temperatures", kind="histogram",
        frame=_FRAME, bars=bars, bar_width=width + 0.3, ticks=ticks,
    )  # fmt: skip


def spread_chart(
    spreads: Sequence[TemperatureSpread], low: float, high: float, unit: str
) -> Markup:
    """SVG with a column per photo: a line from minimum to maximum, a bar over 90 % of the pixels.

    Args:
        spreads: one per photo; the chart is empty without any.
    """
    if not spreads:
        return Markup()
    step = (_WIDTH - _LEFT - _RIGHT) / len(spreads)

    def y(value: float) -> float:
        share = (min(max(value, low), high) - low) / (high - low)
        return _HEIGHT - _BOTTOM - (_HEIGHT - _TOP - _BOTTOM) * share

    columns = [
        (
            f"{item.name}: {number_text(item.lowest, 1)} to {number_text(item.highest, 1)} {unit}",
            _LEFT + (index + 0.5) * step,
            TemperatureSpread(item.name, *(y(value) for value in item[1:])),
        )
        for index, item in enumerate(spreads)
    ]
    ticks = [
        (_HEIGHT - _BOTTOM - (_HEIGHT - _TOP - _BOTTOM) * share, label)
        for share, label in _ticks(low, high, 5, unit)
    ]
    ends = (spreads[0].name, spreads[-1].name if len(spreads) > 1 else "")
    return render(
        _TEMPLATE, text="temperatures of each photo", kind="spread",
        frame=_FRAME, columns=columns, bar_width=min(0.7 * step, 14), ticks=ticks, ends=ends,
    )  # fmt: skip


def _ticks(low: float, high: float, most: int, unit: str) -> list[tuple[float, str]]:
    """Share of the axis and label of each tick; the last label has the unit."""
    values = round_ticks(low, high, most)
    labels = list(tick_labels(values))
    labels[-1:] = [f"{label} {unit}".strip() for label in labels[-1:]]
    return [
        ((value - low) / (high - low), label) for value, label in zip(values, labels, strict=True)
    ]
