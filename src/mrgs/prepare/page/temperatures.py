"""The section on the temperatures: their histogram, each photo's span, and what the files say of
them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from mrgs.pictures.palette import display_range
from mrgs.prepare.page.charts import Span, histogram, span_chart
from mrgs.prepare.page.markup import bullets, fact_table, figure, paragraph, section
from mrgs.prepare.page.shots import Shot

_BINS = 90


def temperatures_section(
    shots: Sequence[Shot],
    spans: Sequence[Span],
    unit: str,
    facts: Sequence[tuple[str, str]],
    notes: Mapping[str, int],
) -> str:
    """The section; nothing where there is no thermal image.

    Args:
        shots: whose pixels the histogram counts.
        spans: of all thermal images.
        unit: °C, or empty for relative values.
        facts: rows of the table.
        notes: what the files say, and of how many photos it is said.
    """
    if not spans:
        return ""
    low, high = min(span.lowest for span in spans), max(span.highest for span in spans)
    low, high = (low, high) if high > low else display_range(np.array([low, high]))
    images = [shot.thermal[np.isfinite(shot.thermal)] for shot in shots if shot.thermal is not None]
    counts, _ = np.histogram(np.concatenate(images), bins=_BINS, range=(low, high))
    what = "temperature" if unit else "relative value, from black to white (°C are not known)"
    bars = histogram(counts.astype(np.float64), low, high, unit)
    content = (
        fact_table(facts)
        + figure(bars, f"All photos: how many pixels have which {what}.")
        + figure(
            span_chart(spans, low, high, unit),
            "Each photo: the line runs from its lowest to its highest value, the bar holds nine "
            "tenths of its pixels. "
            "Neighbours that see the same things should reach about as far.",
        )
        + (paragraph("What the thermal files say:") + bullets(said(notes)) if notes else "")
    )
    return section("temperatures", "Temperatures", content)


def said(notes: Mapping[str, int]) -> list[str]:
    """Sentences that several photos share, each once, with their number."""
    return [text if count == 1 else f"{text} ({count} photos)" for text, count in notes.items()]


def counted(sentences: Sequence[str]) -> dict[str, int]:
    """Each sentence once, in the order of their first appearance, and how often it was there."""
    return dict(Counter(sentences))
