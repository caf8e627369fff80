"""Temperatures of all photos: charts as SVG, and notes from the thermal files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from mrgs.pictures.html import render
from mrgs.pictures.palette import display_range, palette_table, round_ticks, tick_labels
from mrgs.pictures.settings import settings_of
from mrgs.pictures.values import capitalised
from mrgs.prepare.page.views import Preview
from mrgs.scene import THERMAL
from mrgs.scene.radiometry import PhotoRecord
from mrgs.system.wording import counted, number_text

_BINS = 90
_TEMPLATE = "prepare/page/chart.svg"
_WIDTH, _HEIGHT = 900, 190
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, _WIDTH - 12, 10, _HEIGHT - 34
"""Borders of the plot in the drawing."""

_FRAME = {
    "width": _WIDTH,
    "height": _HEIGHT,
    "left": _LEFT,
    "right": _RIGHT,
    "bottom": _BOTTOM,
    "label_y": _HEIGHT - 10,
}
_LABEL_MARGIN = 60
"""Labels nearer than this to the right border end at their tick, px."""


def temperatures(
    previews: Sequence[Preview],
    unit: str,
    facts: Sequence[tuple[str, str]],
    notes: Mapping[str, int],
    total: int,
) -> dict[str, Any] | None:
    """The section ``temperatures`` of ``sections.html``: charts of the thermal images; None without
    any.

    Args:
        previews: views whose pixels are counted, some of ``total`` views or all.
        unit: °C, or empty for relative values.
        notes: sentences from the thermal files, with the number of photos that have each.
    """
    images = {view.name: view.images[THERMAL].pixels for view in previews if THERMAL in view.images}
    known = {name: image[np.isfinite(image)] for name, image in images.items()}
    known = {name: values for name, values in known.items() if values.size}
    if not known:
        return None
    values = np.concatenate([*known.values()])
    low, high = float(values.min()), float(values.max())
    low, high = (low, high) if high > low else display_range(np.array([low, high]))
    counts, _ = np.histogram(values, bins=_BINS, range=(low, high))
    spreads = {name: np.percentile(own, [0, 5, 50, 95, 100]) for name, own in known.items()}
    shown = "All photos" if total == len(previews) else f"{len(previews)} of {total} photos"
    return {
        "has_celsius": bool(unit),
        "facts": facts,
        "histogram": histogram(counts.astype(np.float64), low, high, unit),
        "spreads": spread_chart(spreads, low, high, unit),
        "notes": [
            text if count == 1 else f"{text} ({count} photos)" for text, count in notes.items()
        ],
        "counted": shown,
    }


SETTINGS_THAT_COUNT = ("emissivity", "reflected_c", "distance_m")
"""Without these nobody can judge the temperatures: the page reports where they are missing."""


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


def histogram(counts: Float[np.ndarray, " n"], low: float, high: float, unit: str) -> Markup:
    """SVG of the number of pixels by temperature: ``counts``, not all 0, are one per equal step
    from ``low`` to ``high``."""
    width = (_RIGHT - _LEFT) / len(counts)
    heights = (_BOTTOM - _TOP) * counts / counts.max()
    colors = palette_table("inferno")[np.linspace(20, 235, len(counts)).astype(int)]
    bars = [
        (_LEFT + index * width, _BOTTOM - height, height, "#" + bytes(color).hex())
        for index, (height, color) in enumerate(zip(heights, colors, strict=True))
        if height > 0
    ]
    ticks = [
        (x, label, "end" if x > _WIDTH - _LABEL_MARGIN else "middle")
        for share, label in _ticks(low, high, 8, unit)
        for x in [_LEFT + (_RIGHT - _LEFT) * share]
    ]
    return render(
        _TEMPLATE, text="histogram of the temperatures", kind="histogram",
        frame=_FRAME, bars=bars, bar_width=width + 0.3, ticks=ticks,
    )  # fmt: skip


def spread_chart(
    spreads: Mapping[str, Float[np.ndarray, "5"]], low: float, high: float, unit: str
) -> Markup:
    """SVG with a column per photo: a line from minimum to maximum, a bar over 90 % of the pixels.
    ``spreads`` are minimum, 5 %, median, 95 % and maximum by the view's name; at least one."""
    step = (_RIGHT - _LEFT) / len(spreads)
    columns = [
        (
            f"{name}: {number_text(values[0], 1)} to {number_text(values[-1], 1)} {unit}",
            _LEFT + (index + 0.5) * step,
            (_BOTTOM - (_BOTTOM - _TOP) * (values - low) / (high - low)).tolist(),
        )
        for index, (name, values) in enumerate(spreads.items())
    ]
    ticks = [
        (_BOTTOM - (_BOTTOM - _TOP) * share, label) for share, label in _ticks(low, high, 5, unit)
    ]
    names = list(spreads)
    return render(
        _TEMPLATE, text="temperatures of each photo", kind="spread", frame=_FRAME, columns=columns,
        bar_width=min(0.7 * step, 14), ticks=ticks, ends=(names[0], names[-1] if names[1:] else ""),
    )  # fmt: skip


def _ticks(low: float, high: float, most: int, unit: str) -> list[tuple[float, str]]:
    """Share of the axis and label of each tick; the last label has the unit."""
    values = round_ticks(low, high, most)
    labels = list(tick_labels(values))
    labels[-1:] = [f"{label} {unit}".strip() for label in labels[-1:]]
    return [
        ((value - low) / (high - low), label) for value, label in zip(values, labels, strict=True)
    ]
