"""Charts of the temperatures as SVG, readable in print."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import Float

from mrgs.pictures.palette import palette_table, round_ticks, tick_labels

_WIDTH, _HEIGHT = 900, 190
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 12, 10, 34


@dataclass(frozen=True)
class Span:
    """Temperatures of one photo, in °C or relative: the extremes, and 5 %, 50 % and 95 % of the
    pixels lie below."""

    name: str
    lowest: float
    low: float
    median: float
    high: float
    highest: float


def span_of(name: str, values: Float[np.ndarray, "h w"]) -> Span | None:
    """The span of a thermal image; None if no pixel is valid."""
    known = values[np.isfinite(values)]
    if not known.size:
        return None
    low, median, high = (float(value) for value in np.percentile(known, [5, 50, 95]))
    return Span(name, float(known.min()), low, median, high, float(known.max()))


def histogram(counts: Float[np.ndarray, " n"], low: float, high: float, unit: str) -> str:
    """How many pixels of the whole set have which temperature.

    Args:
        counts: one per equal step from ``low`` to ``high``.
        low: the first step's lower end.
        high: the last step's upper end.
        unit: of both.
    """
    if not counts.sum():
        return ""
    bar = (_WIDTH - _LEFT - _RIGHT) / len(counts)
    colors = palette_table("inferno")[np.linspace(20, 235, len(counts)).astype(int)]
    bars = []
    for index, count in enumerate(counts):
        height = (_HEIGHT - _TOP - _BOTTOM) * count / counts.max()
        if height > 0:
            x, y = _LEFT + index * bar, _HEIGHT - _BOTTOM - height
            color = "#" + bytes(colors[index]).hex()
            bars.append(
                f'<rect x="{x:.1f}" y="{y:.1f}" width="{bar + 0.3:.1f}" height="{height:.1f}" '
                f'fill="{color}"/>'
            )
    axis = _axis_below(low, high, unit)
    return _svg("".join(bars) + axis, "histogram of the temperatures")


def span_chart(spans: Sequence[Span], low: float, high: float, unit: str) -> str:
    """One column per photo: a thin line from its lowest to its highest value, a bar over nine
    tenths of its pixels."""
    if not spans:
        return ""
    step = (_WIDTH - _LEFT - _RIGHT) / len(spans)
    bar = min(0.7 * step, 14)

    def y(value: float) -> float:
        share = (min(max(value, low), high) - low) / (high - low)
        return _HEIGHT - _BOTTOM - (_HEIGHT - _TOP - _BOTTOM) * share

    marks = []
    for index, span in enumerate(spans):
        x = _LEFT + (index + 0.5) * step
        title = f"{span.name}: {span.lowest:.1f} to {span.highest:.1f} {unit}"
        marks.append(
            f"<g><title>{escape(title)}</title>"
            f'<path d="M{x:.1f} {y(span.lowest):.1f}V{y(span.highest):.1f}" class="thin"/>'
            f'<rect x="{x - bar / 2:.1f}" y="{y(span.high):.1f}" width="{bar:.1f}" '
            f'height="{max(y(span.low) - y(span.high), 1):.1f}" class="bar"/>'
            f'<path d="M{x - bar / 2:.1f} {y(span.median):.1f}h{bar:.1f}" class="middle"/></g>'
        )
    first, last = escape(spans[0].name), escape(spans[-1].name)
    below = (
        f'<text x="{_LEFT}" y="{_HEIGHT - 10}">{first}</text>'
        f'<text x="{_WIDTH - _RIGHT}" y="{_HEIGHT - 10}" '
        f'text-anchor="end">{last if len(spans) > 1 else ""}</text>'
    )
    return _svg(_axis_left(low, high, unit) + "".join(marks) + below, "temperatures of each photo")


def _axis_below(low: float, high: float, unit: str) -> str:
    ticks = round_ticks(low, high, 8)
    parts = [f'<path d="M{_LEFT} {_HEIGHT - _BOTTOM}H{_WIDTH - _RIGHT}" class="axis"/>']
    for tick, label in zip(ticks, tick_labels(ticks), strict=True):
        x = _LEFT + (_WIDTH - _LEFT - _RIGHT) * (tick - low) / (high - low)
        parts.append(f'<path d="M{x:.1f} {_HEIGHT - _BOTTOM}v5" class="axis"/>')
        text = f"{label} {unit}" if tick == ticks[-1] else label
        anchor = "end" if x > _WIDTH - 60 else "middle"
        parts.append(
            f'<text x="{x:.1f}" y="{_HEIGHT - 10}" '
            f'text-anchor="{anchor}">{escape(text.strip())}</text>'
        )
    return "".join(parts)


def _axis_left(low: float, high: float, unit: str) -> str:
    ticks = round_ticks(low, high, 5)
    parts = []
    for tick, label in zip(ticks, tick_labels(ticks), strict=True):
        y = _HEIGHT - _BOTTOM - (_HEIGHT - _TOP - _BOTTOM) * (tick - low) / (high - low)
        parts.append(f'<path d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}" class="grid"/>')
        text = f"{label} {unit}" if tick == ticks[-1] else label
        parts.append(
            f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{escape(text.strip())}</text>'
        )
    return "".join(parts)


def _svg(content: str, text: str) -> str:
    return (
        f'<svg class="chart" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" '
        f'aria-label="{escape(text)}">{content}</svg>'
    )
